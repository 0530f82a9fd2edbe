"""Folders that belong to one user alone: nobody else can write there, or lead elsewhere by a link.

A shared folder such as /dev/shm is anybody's: whoever comes first may put a link, or a folder of
their own, where somebody else's files are expected.
"""

import errno
import os
from contextlib import suppress
from pathlib import Path


def memory_folder() -> Path:
    """Return a folder whose files live in memory, or the folder for temporary files.

    Raises:
        OSError: There is neither.
    """
    shared = Path("/dev/shm")  # noqa: S108  the kernel's own shared-memory mount
    if shared.is_dir() and os.access(shared, os.W_OK):
        return shared
    import tempfile

    return Path(tempfile.gettempdir())


def user_folders() -> list[Path]:
    """Return where this user's folder in memory may stand, the best place first.

    The second one is for a user whose place somebody else has taken: nobody but the user can write
    to what stands above it. It comes second because it is small, and gone without a log-in.

    Raises:
        OSError: No folder for temporary files can be written.
    """
    if not hasattr(os, "geteuid"):  # Windows: the folder for temporary files is one's own
        return [memory_folder() / "hilctl"]
    user = os.geteuid()
    return [memory_folder() / f"hilctl-{user}", Path(f"/run/user/{user}/hilctl")]


def private_folder(path: Path, *, make: bool = True) -> Path:
    """Return a folder after a look at whose it is.

    Args:
        path: The folder; what stands above it is trusted.
        make: Make it where it is not there.

    Raises:
        OSError: It can't be made, is a link or no folder, belongs to somebody else, or can be
            written by others.
    """
    if make:
        with suppress(FileExistsError):
            path.mkdir(mode=0o700)
    if not hasattr(os, "geteuid"):  # Windows: what stands in one's own folder is one's own
        if not path.is_dir():
            raise FileNotFoundError(errno.ENOENT, os.strerror(errno.ENOENT), str(path))
        return path
    # Opened, then looked at: a look at the name might see another folder than the one used.
    descriptor = os.open(path, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW)
    try:
        found = os.fstat(descriptor)
    finally:
        os.close(descriptor)
    if found.st_uid != os.geteuid() or found.st_mode & 0o022:
        raise PermissionError(errno.EPERM, "must be yours, and writable by nobody else", str(path))
    return path
