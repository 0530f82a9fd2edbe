"""How much is said: ``--quiet`` and ``--verbose``, which every command takes anywhere."""

import io
import logging
import sys
import traceback
from collections.abc import Iterator
from contextlib import contextmanager

QUIET, VERBOSE = "--quiet", "--verbose"


class Volume:
    """What is left out, and what is said more.

    Attributes:
        quiet: Only warnings, errors, and what ``--json`` asks for are printed; no progress.
        verbose: All log records with time and module, and where an error was raised.
    """

    quiet = False
    verbose = False


def take_volume(words: list[str]) -> None:
    """Take both options out of the words of a command, and keep what they say.

    Args:
        words: The words, the program's name first; they are changed.
    """
    ends = words.index("--") if "--" in words else len(words)
    options = words[1:ends]
    Volume.quiet, Volume.verbose = QUIET in options, VERBOSE in options
    kept = [word for word in options if word not in {QUIET, VERBOSE}]
    words[1:ends] = kept


@contextmanager
def heard_as_asked(*, as_json: bool) -> Iterator[None]:
    """Log, and print or not, as the words of the command say.

    Args:
        as_json: Whether a program reads standard output: then nothing is kept from it.
    """
    shown = logging.StreamHandler()
    loud = "%(asctime)s %(levelname)s %(name)s: %(message)s"
    shown.setFormatter(logging.Formatter(loud if Volume.verbose else "hilctl: %(message)s"))
    logger = logging.getLogger("hilctl")
    logger.handlers[:] = [shown]
    if Volume.verbose:
        logger.setLevel(logging.DEBUG)
    stream = sys.stdout
    if Volume.quiet and not as_json:
        sys.stdout = io.StringIO()
    try:
        yield
    finally:
        sys.stdout = stream


def print_origin() -> None:
    """Print where the error that is being handled was raised, to standard error, if asked for."""
    if Volume.verbose:
        traceback.print_exc()
