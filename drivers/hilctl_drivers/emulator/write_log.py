"""A log of what an emulated device put out, as JSON lines, for judging a run from outside."""

import json
from pathlib import Path
from typing import IO, Any

from hilctl.base.errors import InputError


class WriteLog:
    """One JSON object a line, on disk as soon as it happened.

    Args:
        path: File to write, replaced if it exists; None keeps no log.
        unix_offset_ns: What to add to the monotonic clock to get Unix time.

    Raises:
        InputError: The file can't be written.
    """

    def __init__(self, path: Path | None, unix_offset_ns: int) -> None:
        self._offset_ns = unix_offset_ns
        self._file: IO[bytes] | None = None
        if path is not None:
            try:
                self._file = path.open("wb", buffering=0)
            except OSError as error:
                raise InputError(f"{path}: can't be written: {error.strerror}") from None

    def event(self, now_ns: int, event: str, **more: Any) -> None:
        """Write one line.

        Args:
            now_ns: Monotonic time.
            event: What happened.
            more: Plain values.
        """
        if self._file is None:
            return
        unix_s = (now_ns + self._offset_ns) * 1e-9
        entry = {"event": event, "monotonic_ns": now_ns, "unix_s": unix_s, **more}
        self._file.write(json.dumps(entry).encode() + b"\n")

    def close(self) -> None:
        """Close the file."""
        if self._file is not None:
            self._file.close()
            self._file = None
