"""Private folders, safe from links and writes of other users; file locks.

In a shared folder such as /dev/shm another user may create a link or a folder under any name first.
Locks on open files end with the process that holds them.
"""

import errno
import os
from contextlib import suppress
from pathlib import Path
from typing import IO

try:
    import fcntl
except ImportError:  # Windows, where no runs take place
    fcntl = None  # type: ignore[assignment]


def memory_folder() -> Path:
    """Return a folder in memory, or the folder for temporary files."""
    shared = Path("/dev/shm")  # noqa: S108  the kernel's own shared-memory mount
    if shared.is_dir() and os.access(shared, os.W_OK):
        return shared
    import tempfile

    return Path(tempfile.gettempdir())


def user_folders() -> list[Path]:
    """Return candidates for this user's folder in memory, the best first.

    The second one is safe if another user occupies the first, because only the user can write to
    its parent. It is second because it is small and disappears at log-out.
    """
    if not hasattr(os, "geteuid"):  # Windows: the folder for temporary files is one's own
        return [memory_folder() / "hilctl"]
    user = os.geteuid()
    return [memory_folder() / f"hilctl-{user}", Path(f"/run/user/{user}/hilctl")]


def private_folder(path: Path, *, make: bool = True) -> Path:
    """Return a folder, created if ``make``, after checking its owner and permissions.

    Raise OSError if it cannot be created, is a link or no folder, belongs to another user, or is
    writable by others. Its parent is trusted.
    """
    if make:
        with suppress(FileExistsError):
            path.mkdir(mode=0o700)
    if not hasattr(os, "geteuid"):  # Windows: the user's own folder is private
        if not path.is_dir():
            raise FileNotFoundError(errno.ENOENT, os.strerror(errno.ENOENT), str(path))
        return path
    # Check the opened folder: the name may be redirected in between.
    descriptor = os.open(path, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW)
    try:
        found = os.fstat(descriptor)
    finally:
        os.close(descriptor)
    if found.st_uid != os.geteuid() or found.st_mode & 0o022:
        raise PermissionError(
            errno.EPERM, "must be yours, and not writable by other users", str(path)
        )
    return path


HAS_LOCKS = fcntl is not None
"""Whether the system has such locks."""


def take_lock(held: int | IO[bytes], *, shared: bool = False) -> None:
    """Lock an open file or folder until it is closed; does nothing without system support.

    Raise BlockingIOError if another process holds the lock, OSError if there are no locks.
    """
    if fcntl is not None:
        fcntl.flock(held, (fcntl.LOCK_SH if shared else fcntl.LOCK_EX) | fcntl.LOCK_NB)


def is_locked(held: int | IO[bytes]) -> bool:
    """Return whether another process holds an exclusive lock; False without system support."""
    try:
        # Shared, so that two simultaneous checks do not see each other.
        take_lock(held, shared=True)
    except BlockingIOError:
        return True
    except OSError:
        return False
    release_lock(held)
    return False


def release_lock(held: int | IO[bytes]) -> None:
    """Unlock an open file or folder for all processes that share it."""
    if fcntl is not None:
        fcntl.flock(held, fcntl.LOCK_UN)
