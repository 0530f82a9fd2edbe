"""Who writes to a recording, or recovers one."""

import errno
from io import FileIO
from typing import BinaryIO

from hilctl.base.private_dirs import is_locked, take_lock


def lock(stream: BinaryIO, *, shared: bool = False) -> None:
    """Mark a recording as being written, or (shared) as being recovered, till it is closed.

    Raises:
        BlockingIOError: It is being written by another.
    """
    try:
        take_lock(stream, shared=shared)
    except BlockingIOError:
        stream.close()
        raise BlockingIOError(errno.EAGAIN, "another hilctl is recording to it") from None
    except OSError as error:
        if error.errno not in {errno.ENOLCK, errno.ENOTSUP}:  # a file system without locks
            raise


def is_being_recorded(stream: BinaryIO | FileIO) -> bool:
    """Return whether a run is recording to an open file; where there are no locks, False."""
    return is_locked(stream)
