"""The command line: the only place that prints.

A command is imported when it is called, and imports its heavy parts itself, so that ``--help`` is
quick.

commands.py    the application: which commands there are, and where each one's function is
options.py     options that they share; output.py  JSON, and what all of them say
examples.py    a demonstration, examples to copy; starting.py  a first experiment
running.py     start and check runs; shown by run_view.py
compile_progress.py   progress of compiling kernels
steering.py    status, set, mark and stop; shown by status_view.py
watch.py       a live run in the terminal, with keys to stop and change it
live.py        the page of runs that are going on
listing.py     recordings below a folder, found by what they say
reading.py     judge, replay and export recordings; report_view.py
recordings.py  recover them, identify models; identify_view.py
comparing.py   models against one another; compare_view.py
learning.py    corrections from run to run
campaigning.py  many runs of one experiment; campaign_view.py
characterising.py  a model of a wired actuator; characterise_view.py
machine.py     this computer and its devices; machine_view.py and probe_view.py
console.py     the console that tables go to, and what replay prints; progress.py  a progress bar
volume.py      --quiet and --verbose
streams.py     standard output and error, which all text passes: no control character goes through

Exit codes: 0 done; 1 a replay that differs, an export that left recordings out, a rate that this
machine does not keep, or a model that is none of the actuator; 2 the input can't be used, nothing
has moved; 3 a run that ended by a fault, a device that answers what can't be, or a rig that can't
be characterised; 128 + n a run stopped by signal n.
"""

import signal
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import NoReturn

from hilctl.base.errors import ConfigError, HilctlError, InputError, RunError
from hilctl.base.remedy import reason
from hilctl.cli.output import print_json
from hilctl.cli.streams import plain_streams
from hilctl.cli.volume import heard_as_asked, print_origin, take_volume

ACTING = (
    *("run", "set", "mark", "stop", "safe"),
    *("characterise", "campaign", "sweep", "learn", "demo"),
)
"""Commands that move an actuator, or change a run."""

OF_LINUX = {"fcntl", "grp", "pty", "pwd", "resource", "termios", "tty"}
"""Modules of Python that other systems lack."""


def main() -> None:
    """Run the command line; every error raised on purpose becomes a message and an exit code."""
    take_volume(sys.argv)
    acts = any(name in ACTING for name in sys.argv[1:2])
    with (
        plain_streams(acts=acts),
        _memory_said_once(),
        heard_as_asked(as_json="--json" in sys.argv),
    ):
        try:
            _command()
        except HilctlError as error:
            print_origin()
            _refuse(error)
        except KeyboardInterrupt:
            raise SystemExit(128 + signal.SIGINT) from None
        except OverflowError:
            if _clock_can_be_read():
                raise
            _refuse(
                InputError(
                    "this computer's clock is beyond the year 2262: set it, as with timedatectl"
                )
            )
        except (OSError, EOFError, MemoryError, ImportError, SystemError) as error:
            print_origin()
            _refuse(RunError(machine_refused(error)))


def _clock_can_be_read() -> bool:
    """Return whether the time fits into 64 bits of ns; Python reads no other."""
    try:
        time.time_ns()
    except OverflowError:
        return False
    return True


@contextmanager
def _memory_said_once() -> Iterator[None]:
    """Withhold what Python remarks of errors that nobody can catch where memory has run out.

    It is said once, in words, as the error that ends the command: an import that runs out of memory
    may leave such remarks beside it.
    """
    before = sys.unraisablehook

    def said(what: "sys.UnraisableHookArgs") -> None:
        if not isinstance(what.exc_value, MemoryError):
            before(what)

    sys.unraisablehook = said
    try:
        yield
    finally:
        sys.unraisablehook = before


def _command() -> None:
    from hilctl.cli.commands import app

    app()


def machine_refused(error: Exception) -> str:
    """Say what this machine could not give."""
    if isinstance(error, FileNotFoundError) and error.filename is None:
        return "the folder that it is started in has been deleted: change to another one"
    if isinstance(error, OSError):
        where = f"{error.filename}: " if error.filename is not None else ""
        return f"{where}{reason(error)}"
    if isinstance(error, EOFError):
        return f"data ended unexpectedly: {error}"
    if isinstance(error, MemoryError):
        return f"not enough memory{f': {error}' if str(error) else ''}"
    if isinstance(error, ModuleNotFoundError) and error.name in OF_LINUX:
        from hilctl.run.architecture import WORKS_ANYWHERE

        return f"this needs Linux, whose {error.name!r} is not here: {WORKS_ANYWHERE}"
    # Both are also what is left of an import that ran out of memory.
    return f"a part of the installation can't be loaded, for want of memory or of a file: {error}"


def _refuse(error: HilctlError) -> NoReturn:
    if "--json" in sys.argv:
        problems = [str(p) for p in error.problems] if isinstance(error, ConfigError) else []
        print_json({"error": str(error), "problems": problems})
    for line in str(error).splitlines():
        print(f"hilctl: {line}", file=sys.stderr)
    raise SystemExit(2 if isinstance(error, InputError) else 3)
