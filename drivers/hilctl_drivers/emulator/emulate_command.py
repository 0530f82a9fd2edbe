"""The command ``hilctl emulate``: serves an emulator until a signal ends it."""

import gc
import shlex
import signal
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from types import FrameType
from typing import Annotated, Any, cast

import typer

from hilctl.base.errors import InputError
from hilctl.base.formatting import finite_json
from hilctl_drivers.emulator.experiment_rig import WiredExperiment, is_experiment, wired_experiment
from hilctl_drivers.emulator.factory import Emulator, build
from hilctl_drivers.emulator.faults import parse_fault
from hilctl_drivers.emulator.modbus_device import EmulatedModbus
from hilctl_drivers.emulator.modbus_wire import LinkKind
from hilctl_drivers.emulator.options import EmulatorOptions, ReaderLine


def emulate(
    profile: Annotated[
        str,
        typer.Argument(
            help="Shipped profile, path of a profile, or an experiment (uses its wiring).",
            metavar="PROFILE|EXPERIMENT",
        ),
    ],
    link: Annotated[str | None, typer.Option(help="tcp or rtu; default: from the profile.")] = None,
    host: Annotated[str, typer.Option(help="Address to listen on.")] = EmulatorOptions.host,
    port: Annotated[
        int, typer.Option(min=0, max=65535, help="TCP port; 0 for any free port.")
    ] = EmulatorOptions.port,
    log: Annotated[Path | None, typer.Option(help="Log file for every write.")] = None,
    fault: Annotated[
        list[str] | None,
        typer.Option(metavar="KIND@WHEN", help="KIND@COUNT or KIND@SECONDSs; may be repeated."),
    ] = None,
    output: Annotated[str | None, typer.Option(help="Output that drives the rig.")] = None,
    sensor: Annotated[
        str | None, typer.Option(help="Input that reads the displacement, or READER:INPUT.")
    ] = None,
    reader: Annotated[
        str | None, typer.Option(help="Profile of the device with the input, if separate.")
    ] = None,
    reader_line: Annotated[
        str | None,
        typer.Option(
            help="Line of the reader: same or own; default: same for Modbus RTU, otherwise own."
        ),
    ] = None,
    reader_unit_id: Annotated[int | None, typer.Option(help="Unit id of the reader.")] = None,
    reader_port: Annotated[
        int, typer.Option(min=0, max=65535, help="The reader's own TCP port; 0 for any free port.")
    ] = EmulatorOptions.reader_port,
    current_a: Annotated[
        float | None, typer.Option(help="Initial current, A; default: as after power-up.")
    ] = None,
    as_json: Annotated[
        bool, typer.Option("--json", help="Print one line of JSON when ready.")
    ] = False,
) -> None:
    """Emulate a device with the simulated rig, until Ctrl-C."""
    say = _say_json if as_json else _say
    faults = tuple(parse_fault(text) for text in fault or ())
    if is_experiment(profile):
        own = {"--link": link, "--output": output, "--sensor": sensor, "--reader": reader,
               "--reader-line": reader_line, "--reader-unit-id": reader_unit_id}  # fmt: skip
        if given := [name for name, value in own.items() if value is not None]:
            raise InputError(f"{', '.join(given)}: specified by {profile} already")
        wired = wired_experiment(Path(profile), port, host)
        options = replace(wired.options, log=log, faults=faults, current_a=current_a)
        if reader_port:
            options = replace(options, reader_port=reader_port)
        serve(options, lambda places, emulator: say(places, emulator, wired))
        return
    if reader is None and sensor is not None and ":" in sensor:
        reader, _, sensor = sensor.rpartition(":")
    options = EmulatorOptions(
        profile=profile,
        link=cast(LinkKind | None, link),
        host=host,
        port=port,
        log=log,
        faults=faults,
        output=output,
        sensor=sensor,
        reader=reader,
        reader_line=cast(ReaderLine | None, reader_line),
        reader_unit_id=reader_unit_id,
        reader_port=reader_port,
        current_a=current_a,
    )
    serve(options, say)


@dataclass(frozen=True, slots=True)
class ListenAddress:
    """Where an emulated device answers.

    Attributes:
        profile: Its profile.
        address: ``host:port`` or device file.
        unit_id: Its unit id, where another Modbus device is served beside it.
    """

    profile: str
    address: str
    unit_id: int | None = None


def _say(
    places: Sequence[ListenAddress], emulator: Emulator, wired: WiredExperiment | None = None
) -> None:
    for each in places:
        unit = f", unit {each.unit_id}" if each.unit_id is not None else ""
        typer.echo(f"{each.profile} answers at {each.address}{unit}")
    if wired is not None:
        typer.echo("\n".join([*wired.wiring(), f"hilctl {shlex.join(wired.words(emulator))}"]))


def _say_json(
    places: Sequence[ListenAddress], emulator: Emulator, wired: WiredExperiment | None = None
) -> None:
    said: dict[str, Any] = {"devices": [asdict(each) for each in places]}
    if wired is not None:
        said["wiring"] = wired.wiring_mapping()
        said["arguments"] = wired.words(emulator)
    typer.echo(finite_json(said))


def serve(
    options: EmulatorOptions, on_ready: Callable[[Sequence[ListenAddress], Emulator], None]
) -> None:
    """Serve an emulator until SIGINT or SIGTERM.

    Args:
        options: What to emulate.
        on_ready: Called with where its devices answer, and itself, once they do.

    Raises:
        InputError: See :func:`~hilctl_drivers.emulator.factory.build`.
    """
    emulator = build(options)

    def stop(number: int, frame: FrameType | None) -> None:
        del number, frame
        emulator.server.stop()

    gc.collect()
    gc.freeze()  # a collection of all that was imported takes tens of ms
    before = {each: signal.signal(each, stop) for each in (signal.SIGINT, signal.SIGTERM)}
    try:
        on_ready(_places(options, emulator), emulator)
        emulator.server.run()
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
        emulator.log.close()


def _places(options: EmulatorOptions, emulator: Emulator) -> list[ListenAddress]:
    if options.reader is None:
        return [ListenAddress(options.profile, emulator.address)]
    unit_id = reader_unit_id = None
    if isinstance(emulator.device, EmulatedModbus):
        unit_id = emulator.device.profile.unit_id
        reader_unit_id = emulator.reader_unit_id
    return [
        ListenAddress(options.profile, emulator.address, unit_id),
        ListenAddress(options.reader, emulator.reader_address, reader_unit_id),
    ]
