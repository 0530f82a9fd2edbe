"""The command line: the only place that prints.

A command is imported when it is called, and imports its heavy parts itself, so that ``--help`` is
quick.

application.py  what all commands hang on
commands.py    which commands there are, and where each one's function is
options.py     options that they share; output.py  JSON, and what all of them say
running.py     start and check runs; shown by run_view.py
steering.py    status, set and stop, in a tenth of a second; shown by status_view.py
recordings.py  judge, replay, export and recover them, identify models;
               identify_view.py and report_view.py
comparing.py   models against one another; compare_view.py
learning.py    corrections from run to run
machine.py     this computer and its devices; machine_view.py
console.py     what recordings.py and comparing.py print; progress.py  a progress bar

Exit codes: 0 done; 1 a replay that differs, or a rate that this machine does not keep; 2 the input
can't be used, nothing has moved; 3 a run that ended by a fault; 128 + n a run stopped by signal n.
"""

import logging
import signal
import sys
from importlib import import_module
from typing import Any, NoReturn

from hilctl.base.errors import ConfigError, HilctlError, InputError
from hilctl.cli.output import print_json

STEERING = ("status", "set", "stop")
"""Commands that nobody wants to wait for: they go past the application, which takes longer to
import than they take to run."""


def __getattr__(name: str) -> Any:
    """Import the application when it is asked for."""
    if name != "app":
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return import_module("hilctl.cli.application").app


def main() -> None:
    """Run the command line; every error raised on purpose becomes a message and an exit code."""
    shown = logging.StreamHandler()
    shown.setFormatter(logging.Formatter("hilctl: %(message)s"))
    logging.getLogger("hilctl").handlers[:] = [shown]
    try:
        if len(sys.argv) > 1 and sys.argv[1] in STEERING:
            from hilctl.cli.steering import steer

            raise SystemExit(steer(sys.argv[1], sys.argv[2:]))
        from hilctl.cli.application import app

        app()
    except HilctlError as error:
        _refuse(error)
    except KeyboardInterrupt:
        raise SystemExit(128 + signal.SIGINT) from None


def _refuse(error: HilctlError) -> NoReturn:
    if "--json" in sys.argv:
        problems = [str(p) for p in error.problems] if isinstance(error, ConfigError) else []
        print_json({"error": str(error), "problems": problems})
    for line in str(error).splitlines():
        print(f"hilctl: {line}", file=sys.stderr)
    raise SystemExit(2 if isinstance(error, InputError) else 3)
