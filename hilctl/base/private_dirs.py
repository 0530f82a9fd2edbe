"""Folders that belong to one user alone: nobody else can write there, or lead elsewhere by a link.

A shared folder such as /dev/shm is anybody's: whoever comes first may put a link, or a folder of
their own, where somebody else's files are expected.

Locks on open files end with the process that holds them, however that ends.
"""

import errno
import os
from contextlib import suppress
from pathlib import Path
from typing import IO

try:
    import fcntl
except ImportError:  # Windows: runs need Linux, so there is nobody to be kept out
    fcntl = None  # type: ignore[assignment]


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


HAS_LOCKS = fcntl is not None
"""Whether the system has such locks; one without them (Windows) replaces no open file."""


def take_lock(held: int | IO[bytes], *, shared: bool = False) -> None:
    """Lock an open file or folder until it is closed; nothing where the system has no such locks.

    Args:
        held: It, or its descriptor.
        shared: Whether others may hold it with us; only one that wants it alone is kept out.

    Raises:
        BlockingIOError: Somebody else holds it.
        OSError: The file system has no locks.
    """
    if fcntl is not None:
        fcntl.flock(held, (fcntl.LOCK_SH if shared else fcntl.LOCK_EX) | fcntl.LOCK_NB)


def is_locked(held: int | IO[bytes]) -> bool:
    """Return whether somebody else holds a file alone; where there are no locks, False."""
    try:
        # Shared: two that look at once must not take each other for the holder.
        take_lock(held, shared=True)
    except BlockingIOError:
        return True
    except OSError:
        return False
    if fcntl is not None:
        fcntl.flock(held, fcntl.LOCK_UN)
    return False
