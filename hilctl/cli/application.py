"""The application that all commands hang on."""

from typing import Annotated

import typer

from hilctl import __version__
from hilctl.cli.commands import HELP_NAMES, CommandTable
from hilctl.cli.volume import QUIET, VERBOSE

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
