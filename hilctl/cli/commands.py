"""The application: which commands there are, and a group that imports one only when it is called.

A name stands for where its function is, so that a command may come from ``hilctl_drivers``, which
``hilctl`` never imports, and ``--help`` costs no more than this table.
"""

from importlib import import_module
from typing import Annotated, Any, NamedTuple

import typer
from typer.core import TyperCommand, TyperGroup

from hilctl import __version__
from hilctl.base.errors import InputError, RunError
from hilctl.cli import OF_LINUX, machine_refused
from hilctl.cli.volume import QUIET, VERBOSE


class CommandEntry(NamedTuple):
    """Where a command stands.

    Attributes:
        place: ``module:function``, or ``module:app`` for a group of commands.
        help: What it does, in a line; as its docstring begins.
    """

    place: str
    help: str


COMMANDS: dict[str, CommandEntry] = {
    "demo": CommandEntry(
        "hilctl.cli.examples:demo",
        "Run the simulated rig without and with the inverse, and show what it does.",
    ),
    "examples": CommandEntry(
        "hilctl.cli.examples:examples",
        "List the examples, or copy one and the files it names to where they can be changed.",
    ),
    "init": CommandEntry(
        "hilctl.cli.starting:init",
        "Write a first experiment for a device, small, slow and explained; it asks in a terminal.",
    ),
    "run": CommandEntry(
        "hilctl.cli.running:run",
        "Run an experiment and record it; Ctrl-C ramps to the safe value first.",
    ),
    "check": CommandEntry(
        "hilctl.cli.running:check",
        "Check an experiment and say what it would do; nothing moves.",
    ),
    "status": CommandEntry(
        "hilctl.cli.steering:status", "Say which runs are going on, and where each stands."
    ),
    "set": CommandEntry(
        "hilctl.cli.steering:set_",
        "Move a run's reference without a bump, or take its inverse out and in.",
    ),
    "mark": CommandEntry(
        "hilctl.cli.steering:mark", "Set a mark in a run's recording, at the present sample."
    ),
    "stop": CommandEntry(
        "hilctl.cli.steering:stop", "End a run by its safe ramp, close, and record why."
    ),
    "watch": CommandEntry(
        "hilctl.cli.watch:watch",
        "Show a run in the terminal as it goes on, with keys to stop and change it.",
    ),
    "live": CommandEntry(
        "hilctl.cli.live:live",
        "Serve a page that shows runs as they go on, until Ctrl-C or the end of RUN.",
    ),
    "safe": CommandEntry(
        "hilctl.cli.running:safe",
        "Put a device at its safe value by hand, where no run holds it.",
    ),
    "list": CommandEntry(
        "hilctl.cli.listing:list_recordings",
        "List the recordings below a folder, by what their first and last bytes say.",
    ),
    "report": CommandEntry(
        "hilctl.cli.reading:report",
        "Judge a recording: hysteresis, error, noise, lateness; or many, or a campaign's folder.",
    ),
    "figures": CommandEntry(
        "hilctl.cli.series:figures",
        "Draw the figures that apply to runs, by what varied among them: loops, trends, errors.",
    ),
    "replay": CommandEntry(
        "hilctl.cli.reading:replay",
        "Recompute the commands from the recorded reference and compare them bit for bit.",
    ),
    "export": CommandEntry(
        "hilctl.cli.reading:export",
        "Write a recording's samples as CSV, NumPy, Parquet or MATLAB file.",
    ),
    "recover": CommandEntry(
        "hilctl.cli.recordings:recover",
        "Make a recording that was cut short whole again; the bytes as they were stay as RUN.torn.",
    ),
    "identify": CommandEntry(
        "hilctl.cli.recordings:identify",
        "Identify a model's parameters from recordings or measured tables.",
    ),
    "refine": CommandEntry(
        "hilctl.cli.refining:refine",
        "Improve a model from recordings of runs; it is written only where it has become better.",
    ),
    "compare": CommandEntry(
        "hilctl.cli.comparing:compare",
        "Identify models of the literature on the same loops, and compare them.",
    ),
    "characterise": CommandEntry(
        "hilctl.cli.characterising:characterise",
        "Find a model of a wired actuator: measure within its limits, identify, judge.",
    ),
    "campaign": CommandEntry(
        "hilctl.cli.campaigning:campaign",
        "Run an experiment again and again with other values of its keys; goes on where it was.",
    ),
    "sweep": CommandEntry(
        "hilctl.cli.campaigning:sweep",
        "Run an experiment with several values of one or more of its keys: a campaign in one line.",
    ),
    "learn": CommandEntry(
        "hilctl.cli.learning:learn",
        "Learn a correction for a reference that repeats: run, correct, and run again.",
    ),
    "doctor": CommandEntry(
        "hilctl.cli.machine:doctor",
        "Say what keeps this machine from real time, and measure whether it keeps a rate.",
    ),
    "devices": CommandEntry(
        "hilctl.cli.machine:devices_app",
        "List devices, shipped profiles and the serial ports of this machine; nothing is opened.",
    ),
    "emulate": CommandEntry(
        "hilctl_drivers.emulator.command:emulate",
        "Serve the simulated rig as a real device would, until Ctrl-C.",
    ),
    "schema": CommandEntry(
        "hilctl.cli.machine:schema", "Print the JSON schema of experiment files, for editors."
    ),
}

HELP_NAMES = {"help_option_names": ["-h", "--help"]}


class CommandTable(TyperGroup):
    """The commands of :data:`COMMANDS`; help and suggestions know them before they are loaded."""

    def __init__(self, **settings: Any) -> None:
        lines = {name: TyperCommand(name, help=entry.help) for name, entry in COMMANDS.items()}
        super().__init__(**{**settings, "commands": lines})

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        """Write each command's whole line, where typer would cut it."""
        del ctx
        with formatter.section("Commands"):
            formatter.write_dl([(name, entry.help) for name, entry in COMMANDS.items()])

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        """Return the name of the command that is called, the command, and its arguments."""
        name, line, rest = super().resolve_command(ctx, args)
        return name, line and load(line.name or ""), rest

    def invoke(self, ctx: Any) -> Any:
        """Run the command.

        Raises:
            RunError: Data ended unexpectedly. typer would report that as Ctrl-D at a prompt, for
                which a prompt itself raises ``typer.Abort``.
        """
        try:
            return super().invoke(ctx)
        except EOFError as error:
            raise RunError(machine_refused(error)) from error


def load(name: str) -> Any:
    """Return a command of the table, ready to be called.

    Raises:
        InputError: It can't be imported: a part of the installation is missing.
    """
    module_name, _, attribute = COMMANDS[name].place.partition(":")
    try:
        found = getattr(import_module(module_name), attribute)
    except (ImportError, AttributeError) as error:
        if error.name in OF_LINUX:
            raise
        raise InputError(f"{name} can't be loaded: {error}") from error
    if isinstance(found, typer.Typer):
        group = typer.main.get_group(found)
        group.name = name
        return group
    alone = typer.Typer(add_completion=False, rich_markup_mode=None, context_settings=HELP_NAMES)
    alone.command(name)(found)
    return typer.main.get_command(alone)


app = typer.Typer(
    name="hilctl",
    cls=CommandTable,
    help="Real-time hysteresis compensation for smart-material actuators.",
    no_args_is_help=True,
    add_completion=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,  # rich takes longer to import than all of the rest
    context_settings=HELP_NAMES,
)


def _version(wanted: bool) -> None:
    if wanted:
        print(f"hilctl {__version__}")
        raise typer.Exit


@app.callback()
def _root(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Print the version.")
    ] = False,
    quiet: Annotated[
        bool, typer.Option(QUIET, help="Every command: only warnings and errors; or --json.")
    ] = False,
    verbose: Annotated[
        bool, typer.Option(VERBOSE, help="Every command: the whole log, and where errors arose.")
    ] = False,
) -> None:
    del version, quiet, verbose  # those two are taken before, wherever they stand
