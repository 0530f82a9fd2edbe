"""What the commands share: common options, and printing for programs."""

import json
import sys
from pathlib import Path
from typing import Annotated, Any

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


def print_json(value: dict[str, Any]) -> None:
    """Print one JSON object."""
    print(json.dumps(value, indent=2, allow_nan=False))


def finish_orphans() -> None:
    """Recover what runs whose processes have died left in memory, and say so."""
    from hilctl.run.orphans import recover_orphans

    for orphan in recover_orphans():
        print(f"hilctl: {orphan.name} had died: {orphan.text}", file=sys.stderr)
        kept = f"its samples are kept in {orphan.kept}; the next command tries again"
        done = f"recovered into {orphan.recording}"
        print(f"hilctl: {kept if orphan.kept else done}", file=sys.stderr)
