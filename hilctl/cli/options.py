"""Options that several commands share, and completions of their values for the shell.

The functions here return possible values of an argument or option, with a description if there is
one. Their imports are local, because a command needs them for completion only.
"""

import json
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Annotated, Any

import typer

from hilctl.base.errors import HilctlError


def device_names() -> list[str]:
    """Return devices and shipped profiles."""
    from hilctl.experiment.devices import known_devices

    return [*known_devices(), *profile_names()]


def profile_names() -> list[str]:
    """Return shipped profiles."""
    from hilctl.experiment.devices import shipped_profiles

    return list(shipped_profiles())


def example_names() -> list[tuple[str, str]]:
    """Return shipped examples."""
    from hilctl.experiment.examples import examples_folder, shipped_examples

    return [(each.name, each.description) for each in shipped_examples(examples_folder())]


def run_names() -> list[tuple[str, str]]:
    """Return runs of this user."""
    from hilctl.run.run_folder import runs

    return [(each.card.name, each.card.experiment) for each in runs()]


def recording_paths() -> list[str]:
    """Return recordings in the working folder and in the default folder of recordings."""
    from hilctl.recording.metadata_keys import RECORDINGS

    found = [*Path().glob("*.mcap"), *Path(RECORDINGS).rglob("*.mcap")]
    return sorted(map(str, found))


def experiment_keys(ctx: typer.Context) -> list[tuple[str, str]]:
    """Return the dotted keys of experiments, followed by ``=``, and those of the file's axes."""
    from hilctl.experiment.examples import schema_file

    schema = json.loads(schema_file().read_text(encoding="utf-8"))
    found = dict(_keys(schema["else"], schema["$defs"]))
    of_axes = schema["$defs"]["Experiment_of_axes"]["properties"]["axes"]
    # The parser keeps the argument, because the option to be completed has no value yet.
    for name in _axes_of(Path(ctx.args[0])) if ctx.args else ():
        found |= _keys(of_axes["additionalProperties"], schema["$defs"], f"axes.{name}")
        found[f"axis={name}"] = "this axis alone"
    return [(key if "=" in key else f"{key}=", meaning) for key, meaning in found.items()]


def _axes_of(experiment: Path) -> list[str]:
    """Return the names of the axes of an experiment; none if it cannot be read."""
    from hilctl.base.yaml import Document

    with suppress(HilctlError, OSError, UnicodeError):
        axes = Document(str(experiment), experiment.read_text("utf-8")).data.get("axes")
        return [*axes] if isinstance(axes, dict) else []
    return []


def _keys(node: dict[str, Any], definitions: dict[str, Any], at: str = "") -> Iterator[Any]:
    """Yield dotted key and description of each value in a part of a JSON schema."""
    if "$ref" in node:
        named = definitions[node["$ref"].rpartition("/")[2]]
        node = {**named, "description": node.get("description", "")}
    inner = [*node.get("anyOf", []), *node.get("oneOf", [])]
    for each in inner:
        yield from _keys({"description": node.get("description", ""), **each}, definitions, at)
    for name, value in node.get("properties", {}).items():
        yield from _keys(value, definitions, f"{at}.{name}" if at else name)
    if at and not inner and "properties" not in node and node.get("type") != "null":
        yield at, node.get("description", "")


def recordings_argument(meaning: str, metavar: str = "RUN") -> Any:
    """Return an argument for the files of recordings."""
    return typer.Argument(
        help=meaning, metavar=metavar, autocompletion=recording_paths, parser=_named_path
    )


def _named_path(text: str) -> Path:
    """Return a path; refuse an empty text, such as an unset variable, that would be ``.``."""
    if not text:
        raise typer.BadParameter("must not be empty")
    return Path(text)


ExperimentFile = Annotated[
    Path, typer.Argument(help="Experiment file (YAML).", metavar="EXPERIMENT")
]
RecordingFile = Annotated[Path, recordings_argument("Recording (MCAP).")]
HtmlPage = Annotated[
    Path | None, typer.Option(metavar="FILE", help="HTML page with tables and plots to write.")
]
RunsFolder = Annotated[
    Path | None, typer.Option(help="Folder for the recordings; default: OUTPUT-runs.")
]
Settings = Annotated[
    list[str] | None,
    typer.Option(
        "--set",
        metavar="KEY=VALUE",
        help="Override a dotted key of the file; may be repeated.",
        autocompletion=experiment_keys,
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
