"""Standard output and error: all text on its way to the terminal passes here, whoever wrote it.

File names, files and devices may hold escape sequences, which retitle a window, hide a line, or
make a terminal type. They are shown, not sent. What styles a table itself goes by
:func:`hilctl.cli.console.console`, which shows its texts in the same way first.
"""

import errno
import io
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import TextIO

from hilctl.base.formatting import printable

_READER_IS_GONE = {errno.EPIPE, errno.EIO}
"""A pipe closed early, a terminal hung up: whoever read has chosen to read no more."""


class StandardStream(io.TextIOWrapper):
    """A standard stream that never fails: a run must not end because nobody reads.

    Attributes:
        failure: What went wrong first; what was written afterwards is lost.
    """

    def __init__(self, stream: io.TextIOWrapper) -> None:
        # Letters that the locale lacks are written out; nothing waits in this layer, so that texts
        # by way of several of these come out in order.
        super().__init__(
            stream.buffer,
            encoding=stream.encoding,
            errors="backslashreplace",
            line_buffering=stream.line_buffering,
            write_through=True,
        )
        self.failure: OSError | None = None

    def write(self, text: str) -> int:
        """Write a text as it stands."""
        try:
            return super().write(text)
        except OSError as error:
            self._fail(error)
            return len(text)

    def flush(self) -> None:
        """Pass on what was written."""
        try:
            super().flush()
        except OSError as error:
            self._fail(error)

    def _fail(self, error: OSError) -> None:
        self.failure = self.failure or error
        # What waits in the buffer would fail again at every write, and when the process ends.
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, self.fileno())
        os.close(nowhere)


class PlainStream(StandardStream):
    """A standard stream that shows control characters instead of sending them.

    Attributes:
        styled: The same stream for who sends control characters of their own.
    """

    def __init__(self, stream: io.TextIOWrapper) -> None:
        super().__init__(stream)
        self.styled = StandardStream(stream)

    def write(self, text: str) -> int:
        """Write a text with its control characters written out."""
        super().write(printable(text, lines=True))
        return len(text)

    def leave(self) -> OSError | None:
        """Flush, and let go of the file below; return what went wrong."""
        self.flush()
        self.styled.detach()
        self.detach()
        return self.failure or self.styled.failure


@contextmanager
def plain_streams(*, acts: bool = False) -> Iterator[None]:
    """Have standard output and error show control characters.

    Args:
        acts: Whether the command moves something: then what became of that decides its exit code,
            and not whether it could be printed.

    Raises:
        SystemExit: Standard output could not be written, which is said on standard error.
    """
    _open_missing()
    before = sys.stdout, sys.stderr
    streams = _plain(sys.stdout), _plain(sys.stderr)
    sys.stdout, sys.stderr = streams
    code: object = 0
    try:
        yield
    except SystemExit as end:
        code = end.code
        raise
    finally:
        sys.stdout, sys.stderr = before
        failures = [stream.leave() for stream in streams if isinstance(stream, PlainStream)]
        lost = [each for each in failures if each and each.errno not in _READER_IS_GONE]
        if lost:
            with suppress(OSError):
                what = "the result could not be printed" if acts else "standard output"
                print(f"hilctl: {what}: {lost[0].strerror}", file=sys.stderr, flush=True)
            if not code and not acts:
                raise SystemExit(3)


def _open_missing() -> None:
    """Give descriptors 0 to 2 something to be.

    Else the next file that is opened gets one of these numbers: a recording, into which every
    process that means its standard error would write.
    """
    for number in range(3):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # the lowest number that is free: this one
    for number, name in ((1, "stdout"), (2, "stderr")):
        if getattr(sys, name) is None:
            setattr(sys, name, os.fdopen(number, "w", encoding="utf-8", closefd=False))


def _plain(stream: TextIO) -> TextIO:
    return PlainStream(stream) if isinstance(stream, io.TextIOWrapper) else stream
