"""Commands for a first experiment: demo, examples, init, schema."""

import shlex
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any, Literal, cast

import typer

from hilctl import api
from hilctl.api.runs import default_path, is_set, refuse_existing
from hilctl.base.errors import ConfigError, InputError
from hilctl.base.files import is_file, read_text, write_text
from hilctl.base.types import CommandUnit
from hilctl.base.yaml import Document, dump
from hilctl.cli.console import listing, print_rich
from hilctl.cli.options import AsJson, Settings, device_names, example_names, profile_names
from hilctl.cli.output import print_json, print_result
from hilctl.cli.run import run_progress
from hilctl.experiment.devices import describe, is_path, known_devices, profile_summaries
from hilctl.experiment.examples import copy_example, examples_folder, shipped_examples
from hilctl.experiment.file import schema_text
from hilctl.experiment.template import (
    LIMITS_ASKED,
    TemplateDevice,
    starting_device,
    starting_experiment,
)
from hilctl.run.control.client import finish_dead_runs
from hilctl.run.run_folder import require_linux

_DEMO_S = 3.0
_DEMO_RUNS = (
    ("without", "terfenol_sine_6a_uncompensated", ("waveform.frequency_hz=50",)),
    ("with", "demo", ()),
)


def examples(
    name: Annotated[
        str | None,
        typer.Argument(
            metavar="NAME", help="Example to copy; default: list all.", autocompletion=example_names
        ),
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
        before, results[which] = _demo_run(which, experiment, over, before, as_json=as_json)
    if as_json:
        print_json(results)
    else:
        own = shlex.quote(str(files[-1]))
        print(f"\nNext: change {own}, then\n  hilctl check {own}")
        print(f"  hilctl run {own}\n  hilctl examples")
    if any(each["code"] == "fault" for each in results.values()):
        raise typer.Exit(3)


def _demo_run(
    which: str, experiment: Path, settings: list[str], before: Path | None, *, as_json: bool
) -> tuple[Path, dict[str, Any]]:
    """Run, report and print one of the two runs; return its recording and its facts."""
    with run_progress(quiet=as_json) as on_progress:
        result = api.run(experiment, settings=settings, on_progress=on_progress)
    if result.stop_signal:
        raise typer.Exit(128 + result.stop_signal)
    page = result.path.with_suffix(".html")
    percent = api.report_page(result.path, page, before=before).peak_hysteresis_percent
    if not as_json:
        value = "no value" if percent is None else f"{percent:.2f} % peak hysteresis"
        print(f"{which + ' the inverse':20} {value:28} {result.code}: {result.reason}")
        if result.deadline_misses:
            print(f"{'':20} {result.deadline_misses}")
        print(f"{'':20} {page}")
    return result.path, {
        "recording": str(result.path),
        "page": str(page),
        "code": result.code,
        "peak_hysteresis_percent": percent,
        "deadline_misses": result.deadline_misses,
    }


def init(
    device: Annotated[
        str | None,
        typer.Argument(
            metavar="DEVICE",
            help="Device, shipped profile, or path of a profile (see hilctl devices).",
            autocompletion=device_names,
        ),
    ] = None,
    output: Annotated[
        Path | None, typer.Option(help="Experiment to write; default: DEVICE.yaml.")
    ] = None,
    unit: Annotated[
        Literal["A", "V"] | None,
        typer.Option(help="Unit of the drive: current (default) or voltage."),
    ] = None,
    reader: Annotated[
        str | None,
        typer.Option(
            help="Profile of the device that reads the sensor, if separate.",
            autocompletion=profile_names,
        ),
    ] = None,
    settings: Settings = None,
    as_json: AsJson = False,
) -> None:
    """Write a first experiment for a device (asks questions in a terminal)."""
    asks = sys.stdin.isatty() and sys.stdout.isatty() and not as_json
    if device is None and not asks:
        names = ", ".join(row[0] for row in _device_rows())
        raise InputError(f"DEVICE is missing: specify a device or a profile, such as {names}")
    if device is None:
        print_rich(listing("", _device_rows()))
    name = device or _asked_device("device", _device_rows(), describe)
    path = output or default_path(name)
    refuse_existing(path)  # before any question is asked
    chosen = list(settings or [])
    if asks:
        unit, reader = _answers(name, path, unit, reader, chosen)
    written = api.init(name, path, unit=unit or "A", reader=reader, settings=chosen)
    left = {} if asks else written.to_be_set
    if as_json:
        print_json({"experiment": str(path), "device": written.device.name,
                    "schema": str(written.schema), "to_be_set": [*left]})  # fmt: skip
        return
    print(f"{path}: a first experiment for {written.title}; passes hilctl check")
    for key, question in left.items():
        print(f"  set {key}: {question}")
    print(f"  hilctl check {shlex.quote(str(path))}")


def _device_rows(what: str = "output") -> list[tuple[str, ...]]:
    """Return the simulated rigs and the shipped profiles, all with outputs, or with inputs."""
    simulated = (name for name in known_devices() if name.startswith("simulated_"))
    rows: list[tuple[str, ...]] = [(name, "simulated rig", "output", "none") for name in simulated]
    return [row for row in [*rows, *profile_summaries()] if what in row[2]]


def _asked_device(
    question: str,
    rows: Sequence[tuple[str, ...]],
    accept: Callable[[str], object],
    default: str | None = None,
) -> str:
    """Ask for the name of a device, a part of its row, or the path of a profile."""

    def named(answer: str) -> str:
        names = {default, *known_devices(), *(row[0] for row in rows)}
        exact = is_path(answer) or answer in names
        found = [row for row in rows if answer.lower() in " ".join(row).lower()]
        if not exact and len(found) != 1:
            print_rich(listing("", found or rows))
            raise typer.BadParameter(f"{len(found)} devices match '{answer}'")
        name = answer if exact else found[0][0]
        _ask_again_unless(lambda: accept(name))
        return name

    text = f"{question} (name or part of it, or path of a profile)"
    return str(typer.prompt(text, default=default, value_proc=named))


def _asked_one_of(question: str, names: Sequence[str]) -> str:
    def named(answer: str) -> str:
        found = [name for name in names if name.lower() == answer.strip().lower()]
        if not found:
            raise typer.BadParameter(f"must be one of {', '.join(names)} (got {answer!r})")
        return found[0]

    text = f"{question} ({', '.join(names)})"
    return str(typer.prompt(text, default=names[0], value_proc=named))


def _ask_again_unless(attempt: Callable[[], object], pending: Sequence[str] = ()) -> None:
    """Make a prompt ask again if an attempt fails, except for keys that are ``pending``."""
    try:
        attempt()
    except InputError as error:
        texts = [str(error)]
        if isinstance(error, ConfigError):  # the file that they locate is not written yet
            texts = [str(each).removeprefix(f"{each.where}: ") for each in error.problems
                     if each.key not in pending]  # fmt: skip
        if texts:
            raise typer.BadParameter("\n".join(texts)) from None


def _answers(
    name: str, path: Path, unit: CommandUnit | None, reader: str | None, chosen: list[str]
) -> tuple[CommandUnit | None, str | None]:
    """Ask for what depends on the rig, extend the settings ``chosen``; return unit and reader."""

    def begun(reader: str | None) -> TemplateDevice:
        return starting_device(name, path.parent, unit or "A", reader, chosen)

    if reader is None and (is_path(name) or name not in known_devices()):
        own = "the same device"
        answer = _asked_device(
            "device that reads the sensor", _device_rows("input"),
            lambda each: begun(None if each == own else each), own,
        )  # fmt: skip
        reader = None if answer == own else answer
    for key, names in begun(reader).choices.items():
        if not is_set(key, chosen):
            chosen.append(f"{key}={_asked_one_of(key.partition('.')[2], names)}")
    if unit is None and "amplifier" in begun(reader).section:
        unit = cast(CommandUnit, _asked_one_of("current or voltage of the actuator", ("A", "V")))
    device = begun(reader)
    section = Document(str(path), dump({"device": dict(device.section)}))
    _ask(device, path, device.asked, section, chosen)
    drafted = Document(str(path), starting_experiment(device, path, chosen)[0])
    limits = {f"limits.{key}": text for key, text in LIMITS_ASKED.items()
              if drafted.holds(("limits", key))}  # fmt: skip
    _ask(device, path, limits, drafted, chosen)
    return unit, reader


def _ask(
    device: TemplateDevice,
    path: Path,
    questions: Mapping[str, str],
    defaults: Document,
    chosen: list[str],
) -> None:
    """Ask for values by dotted key; the complete experiment is checked after each answer."""
    keys = [key for key in questions if not is_set(key, chosen)]
    for number, key in enumerate(keys, 1):

        def checked(answer: str, key: str = key, number: int = number) -> str:
            settings = [*chosen, f"{key}={answer.strip()}"]
            _ask_again_unless(lambda: starting_experiment(device, path, settings), keys[number:])
            return settings[-1]

        default = defaults.value(tuple(key.split(".")))
        default = list(default) if isinstance(default, tuple) else default
        text = None if default is None else str(default)
        chosen.append(typer.prompt(questions[key], default=text, value_proc=checked))


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
    if is_file(output) and read_text(output).strip()[:1] not in {"", "{"}:
        raise InputError(f"{output} is not JSON and is not replaced: choose another --output")
    write_text(output, schema_text(), overwrite=True)
