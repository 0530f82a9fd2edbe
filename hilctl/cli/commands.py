"""The typer application: a table of commands, each imported when it is called.

This is the only place of lazy imports on the command line; the commands' modules import what they
need at the top. The table allows a command of ``hilctl_drivers``, which ``hilctl`` never imports.
"""

from importlib import import_module
from typing import Annotated, Any, NamedTuple

import typer
from typer.core import TyperCommand, TyperGroup

from hilctl import __version__
from hilctl.base.errors import InputError, RunError
from hilctl.cli import LINUX_MODULES, system_error_text
from hilctl.cli.verbosity import QUIET, VERBOSE


class CommandEntry(NamedTuple):
    """Location and help of a command.

    Attributes:
        place: ``module:function``, or ``module:app`` for a group of commands.
        help: First line of the function's docstring.
    """

    place: str
    help: str


COMMANDS: dict[str, CommandEntry] = {
    "demo": CommandEntry(
        "hilctl.cli.experiments:demo",
        "Run the simulated rig without and with the inverse and compare the results.",
    ),
    "examples": CommandEntry(
        "hilctl.cli.experiments:examples",
        "List the examples, or copy one with the files it refers to.",
    ),
    "init": CommandEntry(
        "hilctl.cli.experiments:init",
        "Write a first experiment for a device (asks questions in a terminal).",
    ),
    "run": CommandEntry(
        "hilctl.cli.run:run",
        "Run an experiment and record it (Ctrl-C ramps to the safe value first).",
    ),
    "check": CommandEntry(
        "hilctl.cli.run:check",
        "Check an experiment and show what it would do (nothing moves).",
    ),
    "status": CommandEntry(
        "hilctl.cli.control:status",
        "List active runs and their progress.",
    ),
    "set": CommandEntry(
        "hilctl.cli.control:set_",
        "Change the gain or offset of a running reference smoothly, or bypass the inverse.",
    ),
    "mark": CommandEntry(
        "hilctl.cli.control:mark",
        "Add a mark to a run's recording at the current sample.",
    ),
    "stop": CommandEntry(
        "hilctl.cli.control:stop",
        "Stop a run: ramp to the safe value, close the device, record the reason.",
    ),
    "watch": CommandEntry(
        "hilctl.cli.watch:watch",
        "Show a run in the terminal, with keys to stop and change it.",
    ),
    "live": CommandEntry(
        "hilctl.cli.live:live",
        "Serve a live page of active runs, until Ctrl-C or the end of RUN.",
    ),
    "safe": CommandEntry(
        "hilctl.cli.run:safe",
        "Set a device to its safe value (refused while a run uses it).",
    ),
    "list": CommandEntry(
        "hilctl.cli.recordings:list_recordings",
        "List the recordings in a folder (reads metadata only).",
    ),
    "report": CommandEntry(
        "hilctl.cli.reports:report",
        "Evaluate a recording (hysteresis, error, noise, lateness), several, or a campaign.",
    ),
    "figures": CommandEntry(
        "hilctl.cli.reports:figures",
        "Plot the results of runs by what was varied: loops, trends, errors.",
    ),
    "replay": CommandEntry(
        "hilctl.cli.reports:replay",
        "Recompute the commands from the recorded reference and compare them bit for bit.",
    ),
    "export": CommandEntry(
        "hilctl.cli.recordings:export",
        "Export a recording's samples to CSV, NumPy, Parquet or MATLAB.",
    ),
    "recover": CommandEntry(
        "hilctl.cli.recordings:recover",
        "Repair a truncated recording; the original is kept as RUN.torn.",
    ),
    "identify": CommandEntry(
        "hilctl.cli.models:identify",
        "Identify a model's parameters from recordings or measured tables.",
    ),
    "refine": CommandEntry(
        "hilctl.cli.models:refine",
        "Improve a model from recordings of runs (written only if it is better).",
    ),
    "compare": CommandEntry(
        "hilctl.cli.models:compare",
        "Identify models of the literature on the same loops and compare them.",
    ),
    "characterise": CommandEntry(
        "hilctl.cli.characterise:characterise",
        "Measure a connected actuator within its limits, then identify and validate a model.",
    ),
    "campaign": CommandEntry(
        "hilctl.cli.campaigns:campaign",
        "Run an experiment with each combination of varied keys (resumes where it stopped).",
    ),
    "sweep": CommandEntry(
        "hilctl.cli.campaigns:sweep",
        "Run an experiment with several values of one or more keys (a campaign in one line).",
    ),
    "learn": CommandEntry(
        "hilctl.cli.campaigns:learn",
        "Learn a correction for a periodic reference: run, correct, and run again.",
    ),
    "doctor": CommandEntry(
        "hilctl.cli.devices:doctor",
        "Check this computer for real-time problems and measure whether it keeps a rate.",
    ),
    "devices": CommandEntry(
        "hilctl.cli.devices:devices_app",
        "List devices, shipped profiles and serial ports (opens none).",
    ),
    "emulate": CommandEntry(
        "hilctl_drivers.emulator.emulate_command:emulate",
        "Emulate a device with the simulated rig, until Ctrl-C.",
    ),
    "schema": CommandEntry(
        "hilctl.cli.experiments:schema",
        "Print the JSON schema of experiment files, for editors.",
    ),
}

HELP_NAMES = {"help_option_names": ["-h", "--help"]}


class CommandTable(TyperGroup):
    """The commands of :data:`COMMANDS`; help and suggestions do not import them."""

    def __init__(self, **settings: Any) -> None:
        lines = {name: TyperCommand(name, help=entry.help) for name, entry in COMMANDS.items()}
        super().__init__(**{**settings, "commands": lines})

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        """Write each command's help line in full (typer would truncate it)."""
        del ctx
        with formatter.section("Commands"):
            formatter.write_dl([(name, entry.help) for name, entry in COMMANDS.items()])

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        """Return the name of the called command, the command, and its arguments."""
        name, line, rest = super().resolve_command(ctx, args)
        return name, line and load(line.name or ""), rest

    def invoke(self, ctx: Any) -> Any:
        """Run the command.

        Raises:
            RunError: Data ended unexpectedly. typer would report an ``EOFError`` as Ctrl-D at a
                prompt, but prompts raise ``typer.Abort``.
        """
        try:
            return super().invoke(ctx)
        except EOFError as error:
            raise RunError(system_error_text(error)) from error


def load(name: str) -> Any:
    """Return a command of the table.

    Raises:
        InputError: It cannot be imported because a part of the installation is missing.
    """
    module_name, _, attribute = COMMANDS[name].place.partition(":")
    try:
        command = getattr(import_module(module_name), attribute)
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
    context_settings=HELP_NAMES,
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
