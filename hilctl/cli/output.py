"""Standard output and error: verbosity, escaped control characters, JSON.

File names, files and devices may contain escape sequences that retitle a window, hide a line or
make a terminal type. They are printed as text. Tables are styled by
:func:`hilctl.cli.console.console`, which escapes their texts first.
"""

import errno
import io
import logging
import os
import sys
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import Any

from hilctl.base.formatting import finite_json, printable

QUIET, VERBOSE = "--quiet", "--verbose"
_READER_CLOSED = {errno.EPIPE, errno.EIO}
"""Errors of a closed pipe or a terminal that hung up; they are not reported."""


class Verbosity:
    """Amount of output."""

    quiet = False  # print only warnings, errors and ``--json`` output; no progress
    verbose = False  # print all log records with time and module, and the traceback of an error


def take_verbosity(words: list[str]) -> None:
    """Move both options from the arguments of a command (modified) to :class:`Verbosity`."""
    ends = words.index("--") if "--" in words else len(words)
    options = words[1:ends]
    Verbosity.quiet, Verbosity.verbose = QUIET in options, VERBOSE in options
    words[1:ends] = [word for word in options if word not in {QUIET, VERBOSE}]


@contextmanager
def output_as_requested(*, as_json: bool) -> Iterator[None]:
    """Set up logging and standard output for the selected verbosity; JSON is never suppressed."""
    handler = logging.StreamHandler()
    detailed = "%(asctime)s %(levelname)s %(name)s: %(message)s"
    form = detailed if Verbosity.verbose else "hilctl: %(message)s"
    handler.setFormatter(logging.Formatter(form))
    logger = logging.getLogger("hilctl")
    logger.handlers[:] = [handler]
    if Verbosity.verbose:
        logger.setLevel(logging.DEBUG)
    stream = sys.stdout
    if Verbosity.quiet and not as_json:
        sys.stdout = io.StringIO()
    try:
        yield
    finally:
        sys.stdout = stream


def print_traceback() -> None:
    """Print the traceback of the current error to standard error if ``--verbose`` is set."""
    if Verbosity.verbose:
        traceback.print_exc()


class StandardStream(io.TextIOWrapper):
    """A standard stream that never fails; all output after the first ``failure`` is lost."""

    def __init__(self, stream: io.TextIOWrapper) -> None:
        # Characters outside the locale's encoding are escaped. This layer does not buffer, so that
        # texts written through several layers stay in order.
        super().__init__(
            stream.buffer,
            encoding=stream.encoding,
            errors="backslashreplace",
            line_buffering=stream.line_buffering,
            write_through=True,
        )
        self.failure: OSError | None = None

    def write(self, text: str) -> int:
        """Write a text unchanged."""
        try:
            return super().write(text)
        except OSError as error:
            self._fail(error)
            return len(text)

    def flush(self) -> None:
        """Flush the stream."""
        try:
            super().flush()
        except OSError as error:
            self._fail(error)

    def _fail(self, error: OSError) -> None:
        self.failure = self.failure or error
        # Buffered text would fail again at every write and at exit.
        null = os.open(os.devnull, os.O_WRONLY)
        os.dup2(null, self.fileno())
        os.close(null)


class SafeStream(StandardStream):
    """A standard stream that escapes control characters; ``styled`` does not, for tables."""

    def __init__(self, stream: io.TextIOWrapper) -> None:
        super().__init__(stream)
        self.styled = StandardStream(stream)

    def write(self, text: str) -> int:
        """Write a text with its control characters escaped."""
        super().write(printable(text, lines=True))
        return len(text)

    def close_wrapper(self) -> OSError | None:
        """Flush and detach from the underlying file; return the first error."""
        self.flush()
        self.styled.detach()
        self.detach()
        return self.failure or self.styled.failure


@contextmanager
def safe_streams(*, acts: bool = False) -> Iterator[None]:
    """Escape control characters on standard output and error.

    If standard output cannot be written, raise SystemExit with a message on standard error, except
    for a command that ``acts`` on an actuator.
    """
    _open_missing()
    before = sys.stdout, sys.stderr
    streams = [SafeStream(each) if isinstance(each, io.TextIOWrapper) else each for each in before]
    sys.stdout, sys.stderr = streams
    code: object = 0
    try:
        yield
    except SystemExit as end:
        code = end.code
        raise
    finally:
        sys.stdout, sys.stderr = before
        failures = [stream.close_wrapper() for stream in streams if isinstance(stream, SafeStream)]
        lost = [each for each in failures if each and each.errno not in _READER_CLOSED]
        if lost:
            with suppress(OSError):
                what = "the result could not be printed" if acts else "standard output"
                print(f"hilctl: {what}: {lost[0].strerror}", file=sys.stderr, flush=True)
            if not code and not acts:
                raise SystemExit(3)


def _open_missing() -> None:
    """Open the null device for each closed descriptor from 0 to 2."""
    # Otherwise the next file, such as a recording, would get standard error's number.
    for number in range(3):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # takes the lowest free number, this one
    for number, name in ((1, "stdout"), (2, "stderr")):
        if getattr(sys, name) is None:
            setattr(sys, name, os.fdopen(number, "w", encoding="utf-8", closefd=False))


def print_json(value: dict[str, Any]) -> None:
    """Print one JSON object, with ``null`` for numbers that are not finite."""
    print(finite_json(value, indent=2))


def print_result(values: dict[str, Any], show: Callable[[], object], *, as_json: bool) -> None:
    """Print the values of a result as one JSON object, or ``show`` it."""
    if as_json:
        print_json(values)
    else:
        show()
