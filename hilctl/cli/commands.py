"""The typer application: a table of commands, each imported when it is called.

The table allows a command of ``hilctl_drivers``, which ``hilctl`` never imports.
"""

import ast
import signal
import sys
from functools import cache
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated, Any

import typer
from typer.core import TyperCommand, TyperGroup

from hilctl import __version__
from hilctl.base.errors import InputError, RunError
from hilctl.cli import LINUX_MODULES, system_error_text
from hilctl.cli.output import QUIET, VERBOSE, print_json

_MODULES = {
    "hilctl.cli.experiments": ("demo", "examples", "init", "schema"),
    "hilctl.cli.run": ("run", "check", "safe"),
    "hilctl.cli.control": ("status", "set", "mark", "stop"),
    "hilctl.cli.live": ("watch", "live"),
    "hilctl.cli.recordings": ("list", "export", "recover"),
    "hilctl.cli.reports": ("report", "figures", "replay"),
    "hilctl.cli.models": ("identify", "refine", "compare", "export-model"),
    "hilctl.cli.rig": ("calibrate", "characterise"),
    "hilctl.cli.responses": ("frf", "spectrum", "step", "tune"),
    "hilctl.cli.campaigns": ("campaign", "sweep", "learn"),
    "hilctl.cli.devices": ("doctor", "devices"),
    "hilctl_drivers.emulator.emulate_command": ("emulate",),
}
COMMANDS = {name: module for module, names in _MODULES.items() for name in names}
"""The module of each command, in the order of the help.

A command is a function or typer application of its name, with ``_`` for ``-``; ``NAME_`` if NAME
has another meaning in Python.
"""


@cache
def _summaries(module: str) -> dict[str, str]:
    """Return the first docstring line of each function of a module, which is not imported."""
    source = find_spec(module)
    assert source is not None
    assert source.origin is not None
    functions = ast.parse(Path(source.origin).read_bytes()).body
    return {
        each.name.removesuffix("_").replace("_", "-"): str(ast.get_docstring(each)).split("\n")[0]
        for each in functions
        if isinstance(each, ast.FunctionDef)
    }


class CommandLine(TyperCommand):
    """A command that is not imported; its help is the first line of its docstring."""

    def get_short_help_str(self, limit: int = 0) -> str:
        """Return the help line in full (typer would truncate it)."""
        return _summaries(COMMANDS[self.name or ""])[self.name or ""]


HELP_NAMES = {"help_option_names": ["-h", "--help"]}


class CommandTable(TyperGroup):
    """The group of all commands; help and suggestions do not import their modules."""

    def __init__(self, **settings: Any) -> None:
        super().__init__(**{**settings, "commands": {name: CommandLine(name) for name in COMMANDS}})

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        """Write the help line of each command, in the order of the table."""
        with formatter.section("Commands"):
            lines = self.commands.items()
            formatter.write_dl([(name, each.get_short_help_str()) for name, each in lines])

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        """Return the name of the called command, the command, and its arguments."""
        name, line, rest = super().resolve_command(ctx, args)
        return name, line and load(line.name or ""), rest

    def invoke(self, ctx: Any) -> Any:
        """Run the command; data that ended unexpectedly raise RunError."""
        # typer would report an EOFError as Ctrl-D, but prompts raise typer.Abort.
        try:
            return super().invoke(ctx)
        except KeyboardInterrupt:
            signal.signal(signal.SIGINT, signal.SIG_IGN)  # exit waits for threads
            raise
        except EOFError as error:
            raise RunError(system_error_text(error)) from error
        except Exception as error:
            if "--json" in sys.argv and hasattr(error, "format_message"):  # typer prints text only
                print_json({"error": error.format_message(), "problems": []})
            raise


def load(name: str) -> Any:
    """Return a command; raise InputError if a part of the installation is missing."""
    module = COMMANDS[name]
    try:
        found = import_module(module)
        function = name.replace("-", "_")
        command = getattr(found, f"{function}_", None) or getattr(found, function)
    except (ImportError, AttributeError) as error:
        if error.name in LINUX_MODULES:
            raise
        raise InputError(f"cannot load {name}: {error}") from error
    if isinstance(command, typer.Typer):
        group = typer.main.get_group(command)
        group.name = name
        return group
    single = typer.Typer(add_completion=False, rich_markup_mode=None, context_settings=HELP_NAMES)
    single.command(name)(command)
    return typer.main.get_command(single)


app = typer.Typer(
    name="hilctl",
    cls=CommandTable,
    help="Real-time hysteresis compensation for smart-material actuators.",
    no_args_is_help=True,
    add_completion=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,  # rich takes longer to import than everything else
    context_settings={**HELP_NAMES, "color": False},  # SafeStream would escape typer's colours
)


def _version(requested: bool) -> None:
    if requested:
        print(f"hilctl {__version__}")
        raise typer.Exit


@app.callback()
def _root(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Print the version.")
    ] = False,
    quiet: Annotated[
        bool,
        typer.Option(QUIET, help="Print warnings, errors and --json output only (any command)."),
    ] = False,
    verbose: Annotated[
        bool, typer.Option(VERBOSE, help="Print the full log and tracebacks (any command).")
    ] = False,
) -> None:
    del version, quiet, verbose  # take_verbosity has removed the last two
