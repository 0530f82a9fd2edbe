"""The command that writes a first experiment."""

import shlex
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from hilctl.base.errors import InputError
from hilctl.cli.options import AsJson, Settings
from hilctl.cli.output import print_json

if TYPE_CHECKING:
    from hilctl.experiment.starting import StartingDevice


def init(
    device: Annotated[
        str | None,
        typer.Argument(
            metavar="DEVICE", help="Device, shipped profile, or path of your own; hilctl devices."
        ),
    ] = None,
    output: Annotated[
        Path | None, typer.Option(help="Experiment to write; else DEVICE.yaml.")
    ] = None,
    unit: Annotated[
        Literal["A", "V"], typer.Option(help="What drives the actuator: current or voltage.")
    ] = "A",
    reader: Annotated[
        str | None, typer.Option(help="Profile of the device that reads the sensor, if another.")
    ] = None,
    settings: Settings = None,
    as_json: AsJson = False,
) -> None:
    """Write a first experiment for a device, small, slow and explained; it asks in a terminal."""
    from hilctl import api
    from hilctl.api.starting import default_path, refuse_existing
    from hilctl.experiment.starting import starting_device

    asks = sys.stdin.isatty() and sys.stdout.isatty() and not as_json
    name = device or _chosen_device(asks=asks)
    path = output or default_path(name)
    refuse_existing(path)  # before anybody answers questions in vain
    chosen = list(settings or [])
    if asks:
        chosen += _answers(starting_device(name, path.parent, unit, reader), unit, chosen)
    written = api.init(name, path, unit=unit, reader=reader, settings=chosen)
    left = {} if asks else written.to_be_set
    if as_json:
        print_json({"experiment": str(path), "device": written.device.name,
                    "schema": str(written.schema), "to_be_set": [*left]})  # fmt: skip
        return
    print(f"{path}: a first experiment for {written.title}; hilctl check accepts it")
    for key, question in left.items():
        print(f"  set {key}: {question}")
    print(f"  hilctl check {shlex.quote(str(path))}")


def _chosen_device(*, asks: bool) -> str:
    from hilctl.experiment.device import known_devices
    from hilctl.experiment.inventory import shipped_profiles

    names = [name for name in known_devices() if name.startswith("simulated_")]
    names += shipped_profiles()
    if not asks:
        raise InputError(f"name a device or a profile, for example {', '.join(names)}")
    print("\n".join(f"  {name}" for name in names))
    return str(typer.prompt("device, profile, or path of a profile"))


def _answers(begun: "StartingDevice", unit: Literal["A", "V"], settings: list[str]) -> list[str]:
    """Ask for what only the owner of the rig can know; nothing typed keeps what would stand."""
    from hilctl.api.starting import is_set
    from hilctl.experiment.starting import LIMITS_ASKED

    found = []
    for key, question in {**begun.asked, **LIMITS_ASKED[unit]}.items():
        if is_set(key, settings):
            continue
        stands = _standing(begun.section, key.split(".")[1:])
        suffix = f" [{stands}]" if stands else " [Enter: a fifth of what the device takes]"
        answer = typer.prompt(question + suffix, default="", show_default=False)
        if answer.strip():
            found.append(f"{key}={answer.strip()}")
    return found


def _standing(section: Mapping[str, object], parts: list[str]) -> str:
    value: object = section
    for part in parts:
        value = value.get(part) if isinstance(value, Mapping) else None
    return "" if value is None else str(value)
