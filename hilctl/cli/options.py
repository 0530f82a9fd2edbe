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
    typer.Option(
        "--set", metavar="KEY=VALUE", help="Set a dotted key over the file; may be repeated."
    ),
]
LabelTexts = Annotated[
    list[str] | None,
    typer.Option("--label", metavar="KEY=VALUE", help="What the run is found by; may be repeated."),
]
AsJson = Annotated[bool, typer.Option("--json", help="Print one JSON object for programs.")]
Overwrite = Annotated[bool, typer.Option("--overwrite", help="Replace the file if it exists.")]


def with_labels(settings: list[str] | None, labels: list[str] | None) -> list[str]:
    """Return the settings of a command, and its labels as more of them.

    Raises:
        ConfigError: A label is not key=value.
    """
    chosen = list(settings or [])
    if labels:
        from hilctl.experiment.labels import label_settings

        chosen += label_settings(labels)
    return chosen
