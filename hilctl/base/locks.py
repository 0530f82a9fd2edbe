"""Locks on open files, which end with the process that holds them, however that ends."""

from typing import IO

try:
    import fcntl
except ImportError:  # Windows: runs need Linux, so there is nobody to be kept out
    fcntl = None  # type: ignore[assignment]


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
