"""Options ``--quiet`` and ``--verbose``, accepted anywhere on the command line."""

import io
import logging
import sys
import traceback
from collections.abc import Iterator
from contextlib import contextmanager

QUIET, VERBOSE = "--quiet", "--verbose"


class Verbosity:
    """Amount of output.

    Attributes:
        quiet: Print only warnings, errors and ``--json`` output; no progress.
        verbose: Print all log records with time and module, and the traceback of an error.
    """

    quiet = False
    verbose = False


def take_verbosity(words: list[str]) -> None:
    """Remove both options from the arguments of a command and store them in :class:`Verbosity`.

    Args:
        words: The arguments, the program's name first; modified in place.
    """
    ends = words.index("--") if "--" in words else len(words)
    options = words[1:ends]
    Verbosity.quiet, Verbosity.verbose = QUIET in options, VERBOSE in options
    kept = [word for word in options if word not in {QUIET, VERBOSE}]
    words[1:ends] = kept


@contextmanager
def output_as_requested(*, as_json: bool) -> Iterator[None]:
    """Set up logging and standard output for the selected verbosity.

    Args:
        as_json: Whether standard output is JSON for a program; it is never suppressed.
    """
    handler = logging.StreamHandler()
    detailed = "%(asctime)s %(levelname)s %(name)s: %(message)s"
    handler.setFormatter(
        logging.Formatter(detailed if Verbosity.verbose else "hilctl: %(message)s")
    )
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
