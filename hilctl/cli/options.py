"""Options that several commands share."""

from pathlib import Path
from typing import Annotated

import typer

ExperimentFile = Annotated[
    Path, typer.Argument(help="Experiment file (YAML).", metavar="EXPERIMENT")
]
RecordingFile = Annotated[Path, typer.Argument(help="Recording (MCAP).", metavar="RUN")]
Settings = Annotated[
    list[str] | None,
    typer.Option(
        "--set", metavar="KEY=VALUE", help="Override a dotted key of the file; may be repeated."
    ),
]
LabelTexts = Annotated[
    list[str] | None,
    typer.Option("--label", metavar="KEY=VALUE", help="Label to find the run by; may be repeated."),
]
AsJson = Annotated[bool, typer.Option("--json", help="Print one JSON object for programs.")]
Overwrite = Annotated[bool, typer.Option("--overwrite", help="Replace the file if it exists.")]
FromTime = Annotated[
    float | None, typer.Option("--from", metavar="S", help="Start at this time of the run, s.")
]
ToTime = Annotated[
    float | None, typer.Option("--to", metavar="S", help="Stop at this time of the run, s.")
]
Fast = Annotated[
    bool, typer.Option("--fast", help="Simulate without waiting (simulated devices only).")
]
DryRun = Annotated[bool, typer.Option("--dry-run", help="Show the plan only (nothing moves).")]
