"""Put a new file in the place of an old one, and keep the old one."""

import os
from pathlib import Path

from hilctl.base.files import AtomicFile


class Replacement:
    """A file in the making, beside the one it is for; closed without :meth:`put` it is removed.

    Args:
        path: The old file; where it is a link, the file that it leads to.
        output: Where the new file goes instead of the old one's place.

    Attributes:
        stream: The new file, open for writing.
        final: Where it goes.

    Raises:
        FileExistsError: ``output`` exists.
        OSError: The folder can't be written.
    """

    def __init__(self, path: Path, output: Path | None) -> None:
        self._old = path.resolve()
        self._in_place = output is None
        self._file = AtomicFile(self._old if output is None else output, overwrite=output is None)
        self.final = self._file.final
        self.stream = self._file.stream
        Path(self.stream.name).chmod(self._old.stat().st_mode)

    def put(self) -> Path:
        """Move the new file, safe on the disk, to its place; return where the old one is now.

        There is a whole file under the old name at every moment; on file systems without hard
        links there is none for as long as one renaming takes.
        """
        self._file.secure()  # before the old file is touched: a full disk must change nothing
        kept = self._keep() if self._in_place else self._old
        self._file.commit()
        return kept

    def close(self) -> None:
        """Close the new file; remove it where it was not put."""
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
