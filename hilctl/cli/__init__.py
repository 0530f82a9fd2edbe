"""The command line: the only package that prints.

Exit codes: 0 success; 1 a replay that differs, an incomplete export, a rate that this computer does
not keep, or an invalid model; 2 invalid input, nothing has moved; 3 a run that ended by a fault, a
device with implausible answers, or a rig that cannot be characterised; 128 + n a run stopped by
signal n.
"""

import os
import signal
import sys
from typing import NoReturn

from hilctl import OWN_ENVIRONMENT
from hilctl.api.words import options_kept
from hilctl.base.errors import ConfigError, HilctlError, RunError
from hilctl.base.files import reason
from hilctl.cli.output import (
    output_as_requested,
    print_json,
    print_traceback,
    safe_streams,
    take_verbosity,
)
from hilctl.run.run_folder import WORKS_ANYWHERE

ACTING = (
    *("run", "set", "mark", "stop", "safe"),
    *("calibrate", "characterise", "campaign", "sweep", "learn", "demo"),
)
"""Commands that move an actuator or change a run."""

LINUX_MODULES = {"fcntl", "grp", "pty", "pwd", "resource", "termios", "tty"}
"""Modules of Python that other systems do not have."""


def main() -> None:
    """Run the command line and turn every expected error into a message and an exit code."""
    for name, value in OWN_ENVIRONMENT.items():
        os.environ.setdefault(name, value)
    take_verbosity(sys.argv)
    if sys.argv[1:2] == ["help"]:
        sys.argv[1:] = [*sys.argv[2:], "--help"]
    acts = any(name in ACTING for name in sys.argv[1:2])
    if acts and hasattr(signal, "SIGTTOU"):
        # With stty tostop, output of a background job would suspend it: a supervisor, or a command
        # between its runs.
        signal.signal(signal.SIGTTOU, signal.SIG_IGN)
    output = output_as_requested(as_json="--json" in sys.argv)
    with safe_streams(acts=acts), output, options_kept():
        try:
            _run_app()
        except HilctlError as error:
            print_traceback()
            _refuse(error)
        except KeyboardInterrupt:
            raise SystemExit(128 + signal.SIGINT) from None
        except (OSError, EOFError, MemoryError, ImportError, SystemError) as error:
            print_traceback()
            _refuse(RunError(system_error_text(error)))


def _run_app() -> None:
    from hilctl.cli.commands import app

    app()


def system_error_text(error: Exception) -> str:
    """Return the message for an error of the operating system or the installation."""
    if isinstance(error, FileNotFoundError) and error.filename is None:
        return "the working folder has been deleted: change to another one"
    if isinstance(error, OSError):
        where = f"{error.filename}: " if error.filename is not None else ""
        return f"{where}{reason(error)}"
    if isinstance(error, EOFError):
        return f"data ended unexpectedly: {error}"
    if isinstance(error, MemoryError):
        return f"not enough memory{f': {error}' if str(error) else ''}"
    if isinstance(error, ModuleNotFoundError) and error.name in LINUX_MODULES:
        return f"this command needs Linux (no module {error.name!r}): {WORKS_ANYWHERE}"
    # An import that runs out of memory raises ImportError or SystemError as well.
    return f"cannot load a part of the installation (too little memory, or a missing file): {error}"


def _refuse(error: HilctlError) -> NoReturn:
    if "--json" in sys.argv:
        problems = [str(p) for p in error.problems] if isinstance(error, ConfigError) else []
        print_json({"error": str(error), "problems": problems})
    for line in [*str(error).splitlines(), *getattr(error, "__notes__", ())]:
        print(f"hilctl: {line}", file=sys.stderr)
    raise SystemExit(error.exit_code)
