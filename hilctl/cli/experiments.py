"""Commands for a first experiment: demo, examples, init, schema."""

import shlex
import sys
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from hilctl import api
from hilctl.api.runs import default_path, is_set, refuse_existing
from hilctl.base.errors import InputError
from hilctl.base.files import read_text, write_text
from hilctl.cli.console import listing, print_rich
from hilctl.cli.options import AsJson, Settings
from hilctl.cli.output import print_json, print_result
from hilctl.cli.run import run_progress
from hilctl.experiment.devices import known_devices, shipped_profiles
from hilctl.experiment.examples import copy_example, examples_folder, shipped_examples
from hilctl.experiment.file import schema_text
from hilctl.experiment.template import LIMITS_ASKED, starting_device
from hilctl.run.control.client import finish_dead_runs
from hilctl.run.run_folder import require_linux

_DEMO_S = 3.0
_DEMO_RUNS = (
    ("without", "terfenol_sine_6a_uncompensated", ("waveform.frequency_hz=50",)),
    ("with", "demo", ()),
)


def examples(
    name: Annotated[
        str | None, typer.Argument(metavar="NAME", help="Example to copy; default: list all.")
    ] = None,
    into: Annotated[Path, typer.Option(help="Folder for the copies.")] = Path(),
    as_json: AsJson = False,
) -> None:
    """List the examples, or copy one with the files it refers to."""
    folder = examples_folder()
    if name is not None:
        copies = [str(path) for path in copy_example(name, into, folder)]
        values = {"example": name, "files": copies}
        print_result(values, lambda: print("\n".join(copies)), as_json=as_json)
        return
    listed = shipped_examples(folder)
    if as_json:
        print_json({"examples": [{**asdict(each), "path": str(each.path)} for each in listed]})
        return
    print_rich(listing("", [(example.name, example.description) for example in listed]))
    print("\nhilctl examples NAME copies an example and its files into this folder")


def demo(
    folder: Annotated[
        Path, typer.Option(help="Folder for experiments, recordings and pages.")
    ] = Path("hilctl-demo"),
    as_json: AsJson = False,
) -> None:
    """Run the simulated rig without and with the inverse and compare the results."""
    require_linux()
    finish_dead_runs()
    files = [copy_example(name, folder, examples_folder())[0] for _, name, _ in _DEMO_RUNS]
    results: dict[str, Any] = {}
    before: Path | None = None
    for (which, _, settings), experiment in zip(_DEMO_RUNS, files, strict=True):
        over = [f"waveform.duration_s={_DEMO_S:g}", f"recording.folder={folder}", *settings]
        with run_progress(quiet=as_json) as on_progress:
            result = api.run(experiment, settings=over, on_progress=on_progress)
        if result.stop_signal:
            raise typer.Exit(128 + result.stop_signal)
        page = result.path.with_suffix(".html")
        report = api.report_page(result.path, page, before=before)
        before = result.path
        results[which] = {
            "recording": str(result.path),
            "page": str(page),
            "code": result.code,
            "peak_hysteresis_percent": report.peak_hysteresis_percent,
            "deadline_misses": result.deadline_misses,
        }
        if not as_json:
            _print_demo_run(which, results[which], result.reason)
    if as_json:
        print_json(results)
    else:
        own = shlex.quote(str(files[-1]))
        print(f"\nNext: change {own}, then\n  hilctl check {own}")
        print(f"  hilctl run {own}\n  hilctl examples")
    if any(each["code"] == "fault" for each in results.values()):
        raise typer.Exit(3)


def _print_demo_run(which: str, result: dict[str, Any], reason: str) -> None:
    hysteresis = result["peak_hysteresis_percent"]
    value = "no value" if hysteresis is None else f"{hysteresis:.2f} % peak hysteresis"
    print(f"{which + ' the inverse':20} {value:28} {result['code']}: {reason}")
    if result["deadline_misses"]:
        print(f"{'':20} {result['deadline_misses']}")
    print(f"{'':20} {result['page']}")


def init(
    device: Annotated[
        str | None,
        typer.Argument(
            metavar="DEVICE",
            help="Device, shipped profile, or path of a profile (see hilctl devices).",
        ),
    ] = None,
    output: Annotated[
        Path | None, typer.Option(help="Experiment to write; default: DEVICE.yaml.")
    ] = None,
    unit: Annotated[
        Literal["A", "V"], typer.Option(help="Unit of the drive: current or voltage.")
    ] = "A",
    reader: Annotated[
        str | None, typer.Option(help="Profile of the device that reads the sensor, if separate.")
    ] = None,
    settings: Settings = None,
    as_json: AsJson = False,
) -> None:
    """Write a first experiment for a device (asks questions in a terminal)."""
    asks = sys.stdin.isatty() and sys.stdout.isatty() and not as_json
    name = device or _chosen_device(asks=asks)
    path = output or default_path(name)
    refuse_existing(path)  # before any question is asked
    chosen = list(settings or [])
    if asks:
        begun = starting_device(name, path.parent, unit, reader)
        chosen += _answers({**begun.asked, **LIMITS_ASKED[unit]}, begun.section, chosen)
    written = api.init(name, path, unit=unit, reader=reader, settings=chosen)
    left = {} if asks else written.to_be_set
    if as_json:
        print_json({"experiment": str(path), "device": written.device.name,
                    "schema": str(written.schema), "to_be_set": [*left]})  # fmt: skip
        return
    print(f"{path}: a first experiment for {written.title}; passes hilctl check")
    for key, question in left.items():
        print(f"  set {key}: {question}")
    print(f"  hilctl check {shlex.quote(str(path))}")


def _chosen_device(*, asks: bool) -> str:
    names = [name for name in known_devices() if name.startswith("simulated_")]
    names += shipped_profiles()
    if not asks:
        raise InputError(
            f"DEVICE is missing: specify a device or a profile, such as {', '.join(names)}"
        )
    print("\n".join(f"  {name}" for name in names))
    return str(typer.prompt("device, profile, or path of a profile"))


def _answers(
    questions: Mapping[str, str], section: Mapping[str, object], settings: list[str]
) -> list[str]:
    """Ask for the values of the rig; an empty answer keeps the default."""
    answers = []
    for key, question in questions.items():
        if is_set(key, settings):
            continue
        default = _default(section, key.split(".")[1:])
        suffix = f" [{default}]" if default else " [Enter: a fifth of the device's range]"
        answer = typer.prompt(question + suffix, default="", show_default=False)
        if answer.strip():
            answers.append(f"{key}={answer.strip()}")
    return answers


def _default(section: Mapping[str, object], parts: list[str]) -> str:
    value: object = section
    for part in parts:
        value = value.get(part) if isinstance(value, Mapping) else None
    return "" if value is None else str(value)


def schema(
    output: Annotated[
        Path | None, typer.Option(help="File to write; default: standard output.")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Print the JSON schema of experiment files, for editors."""
    del as_json  # the output is always JSON
    if output is None:
        print(schema_text(), end="")
        return
    if output.is_file() and read_text(output).strip()[:1] not in {"", "{"}:
        raise InputError(f"{output} is not JSON and is not replaced: choose another --output")
    write_text(output, schema_text(), overwrite=True)
