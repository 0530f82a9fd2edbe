"""Locks on recording files, and safe replacement of a file."""

import errno
import os
from io import FileIO
from pathlib import Path
from typing import BinaryIO

from hilctl.base.files import AtomicFile
from hilctl.base.private_dirs import is_locked, take_lock


def lock(stream: BinaryIO, *, shared: bool = False) -> None:
    """Mark a recording as being written, or as being recovered (shared), until the file is closed.

    Raise BlockingIOError if another process is writing it.
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
    """Return whether a run is recording to an open file; False on a file system without locks."""
    return is_locked(stream)


class Replacement:
    """A new file that replaces an old one; :meth:`close` without :meth:`put` removes it.

    Raise FileExistsError if ``output`` exists, OSError if the folder cannot be written.
    """

    def __init__(self, path: Path, output: Path | None) -> None:
        self._old = path.resolve()
        self._in_place = output is None
        self._file = AtomicFile(self._old if output is None else output, overwrite=output is None)
        self.final = self._file.final
        self.stream = self._file.stream
        Path(self.stream.name).chmod(self._old.stat().st_mode)

    def put(self) -> Path:
        """Sync the new file, move it to its destination, and return the path of the old one.

        The old name always refers to a complete file, except during one renaming on file systems
        without hard links.
        """
        self._file.secure()  # before the old file is touched: a full disk must change nothing
        kept = self._keep() if self._in_place else self._old
        self._file.commit()
        return kept

    def close(self) -> None:
        """Close the new file; remove it unless :meth:`put` has moved it."""
        self._file.close()

    def _keep(self) -> Path:
        number = 1
        while True:
            kept = self._old.with_name(f"{self._old.name}.torn{'' if number == 1 else number}")
            try:
                kept.hardlink_to(self._old)
                return kept
            except FileExistsError:
                number += 1
            except OSError:  # no hard links here
                if not os.path.lexists(kept):
                    return self._old.rename(kept)
                number += 1
