"""Options that the commands share."""

from pathlib import Path
from typing import Annotated

import typer

ExperimentFile = Annotated[
    Path, typer.Argument(help="Experiment file (YAML).", metavar="EXPERIMENT")
]
RecordingFile = Annotated[Path, typer.Argument(help="Recording (MCAP).", metavar="RUN")]
Settings = Annotated[
    list[str] | None,
    typer.Option("--set", help="Set dotted.key=value over the file; may be repeated."),
]
AsJson = Annotated[bool, typer.Option("--json", help="Print one JSON object for programs.")]
Overwrite = Annotated[bool, typer.Option("--overwrite", help="Replace the file if it exists.")]
