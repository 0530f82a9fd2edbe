"""The typer application: a table of commands, each imported when it is called.

The table allows a command of ``hilctl_drivers``, which ``hilctl`` never imports.
"""

import signal
import sys
from importlib import import_module
from typing import Annotated, Any

import typer
from typer.core import TyperCommand, TyperGroup

from hilctl import __version__
from hilctl.base.errors import InputError, RunError
from hilctl.cli import LINUX_MODULES, system_error_text
from hilctl.cli.output import QUIET, VERBOSE, print_json

_HELP = {
    "Experiments": {
        "hilctl.cli.experiments": {
            "demo": "Run the simulated rig without and with the inverse and compare the results.",
            "examples": "List the examples, or copy one with the files it refers to.",
            "init": "Write a first experiment for a device (asks questions in a terminal).",
            "schema": "Print the JSON schema of experiment files, for editors.",
        },
    },
    "Run and watch": {
        "hilctl.cli.run": {
            "run": "Run an experiment and record it (Ctrl-C ramps to the safe value first).",
            "check": "Check an experiment and show what it would do (nothing moves).",
            "safe": "Set the device of each axis to its safe value (refused while a run uses one).",
        },
        "hilctl.cli.control": {
            "status": "List active runs and their progress.",
            "set": "Change the gain or offset of a running reference smoothly, or bypass the "
            "inverse.",
            "mark": "Add a mark to a run's recording at the current sample.",
            "stop": "Stop a run: ramp to the safe value, close the device, record the reason.",
        },
        "hilctl.cli.live": {
            "watch": "Show a run in the terminal, with keys to stop and change it.",
            "live": "Serve a live page of active runs, until Ctrl-C or the end of RUN.",
        },
    },
    "Recordings": {
        "hilctl.cli.recordings": {
            "list": "List the recordings in a folder (reads metadata only).",
            "export": "Export a recording's samples to CSV, NumPy, Parquet or MATLAB.",
            "recover": "Repair a truncated recording; the original is kept as RUN.torn.",
        },
        "hilctl.cli.reports": {
            "report": "Evaluate recordings or a campaign: hysteresis, error, noise, lateness.",
            "figures": "Plot the results of runs by what was varied: loops, trends, errors.",
            "replay": "Recompute commands from the recorded reference and compare them bit for "
            "bit.",
        },
    },
    "Models": {
        "hilctl.cli.models": {
            "identify": "Identify a model's parameters from recordings or measured tables.",
            "refine": "Improve a model from recordings of runs (written only if it is better).",
            "compare": "Identify models of the literature on the same loops and compare them.",
            "export-model": "Write the inverse of a model as one C or MATLAB function.",
        },
    },
    "Rig": {
        "hilctl.cli.rig": {
            "calibrate": "Calibrate the sensor from a table, or the amplifier by small steps.",
            "characterise": "Measure a connected actuator within its limits, then identify and "
            "validate a model.",
            "couple": "Identify the crosstalk between the axes of a stage, and verify its removal.",
        },
        "hilctl.cli.responses": {
            "frf": "Measure the frequency response of runs: gain, phase, coherence, resonance.",
            "spectrum": "Measure harmonics of a sine, and noise, drift, Allan deviation at rest.",
            "step": "Measure the response to the largest step: rise, settling, overshoot, ringing.",
            "tune": "Propose the feedback's gain from a measured response, with its margins.",
        },
    },
    "Studies": {
        "hilctl.cli.campaigns": {
            "campaign": "Run an experiment with each combination of varied keys (a stopped "
            "campaign resumes).",
            "sweep": "Run an experiment with several values of one or more keys (a campaign in one "
            "line).",
            "learn": "Learn a correction for a periodic reference: run, correct, and run again.",
        },
    },
    "Devices": {
        "hilctl.cli.devices": {
            "doctor": "Check this computer for real-time problems and measure whether it keeps a "
            "rate.",
            "devices": "List devices, shipped profiles and serial ports (opens none).",
        },
        "hilctl_drivers.emulator.emulate_command": {
            "emulate": "Emulate a device with simulated rigs, until Ctrl-C.",
        },
    },
}
"""Help of each command, by group, module and name: the first line of its docstring."""
GROUPS = {
    group: tuple(name for names in modules.values() for name in names)
    for group, modules in _HELP.items()
}
"""The commands of each group, in the order of the help."""
_LINES = {
    name: (module, text)
    for modules in _HELP.values()
    for module, names in modules.items()
    for name, text in names.items()
}
COMMANDS = {name: module for name, (module, _) in _LINES.items()}
"""The module of each command, in the order of the help.

A command is a function or typer application of its name, with ``_`` for ``-``; ``NAME_`` if NAME
has another meaning in Python.
"""
HELP_NAMES = {"help_option_names": ["-h", "--help"]}


class CommandTable(TyperGroup):
    """The group of all commands; help and suggestions do not import their modules."""

    def __init__(self, **settings: Any) -> None:
        lines = {name: TyperCommand(name, short_help=text) for name, (_, text) in _LINES.items()}
        super().__init__(**{**settings, "commands": lines})

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        """Write the help line of each command by group, with all texts in one column."""
        width = max(map(len, COMMANDS))
        for group, names in GROUPS.items():
            lines = [
                (f"{name:{width}}", self.commands[name].get_short_help_str()) for name in names
            ]
            with formatter.section(group):
                formatter.write_dl(lines)

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
