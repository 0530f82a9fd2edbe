"""A recording that somebody deletes, renames or empties while it is written."""

import os
import shutil
from contextlib import suppress
from pathlib import Path

from hilctl.recording.locks import lock


def is_emptied(descriptor: int, had_bytes: int) -> bool:
    """Return whether somebody has cut an open recording short.

    What is written after that stands behind a hole, which makes the size what it was: then the
    file begins with zeros, as no recording does.

    Args:
        descriptor: Of the recording.
        had_bytes: Its size when it was flushed last.

    Raises:
        OSError: It can't be looked at.
    """
    if os.fstat(descriptor).st_size < had_bytes:
        return True
    with Path(f"/proc/self/fd/{descriptor}").open("rb", buffering=0) as content:
        return content.read(1) == b"\0"


def put_back(path: Path, descriptor: int) -> tuple[Path, str]:
    """See to it that an open file, flushed, stands under its name.

    A file that was renamed gets its name back beside the new one. Of one that was deleted the
    content is copied, and ``descriptor`` then leads to the copy.

    Args:
        path: Its name.
        descriptor: Of the file, open for writing.

    Returns:
        Where it is now, and what was done, for people; empty where nothing had to be.

    Raises:
        OSError: It can't be put back.
    """
    own = os.fstat(descriptor)
    with suppress(FileNotFoundError):
        if os.path.samestat(own, path.stat()):
            return path, ""
    opened = Path(f"/proc/self/fd/{descriptor}")  # leads to the file whatever its name
    if own.st_nlink:
        now = opened.readlink()
        try:
            path.hardlink_to(now)
        except OSError:  # the name is taken, or there are no hard links here
            return now, f"was renamed to {now}, and stays there"
        return path, f"was renamed to {now}; it has its name back beside that one"
    free = _free(path)
    try:
        with opened.open("rb") as content, free.open("xb") as copy:
            lock(copy)
            shutil.copyfileobj(content, copy)
            copy.flush()
            os.fsync(copy.fileno())
            # The file's own descriptor: whoever holds the file goes on, and sees no difference.
            os.dup2(copy.fileno(), descriptor, inheritable=False)
    except OSError:
        free.unlink(missing_ok=True)  # half a copy; the next attempt makes another
        raise
    return free, f"was deleted; all that was in it is in {free}"


def _free(path: Path) -> Path:
    """Return the name, or one beside it where somebody has taken it meanwhile."""
    candidate, number = path, 2
    while os.path.lexists(candidate):
        candidate = path.with_name(f"{path.stem}-{number}{path.suffix}")
        number += 1
    return candidate
