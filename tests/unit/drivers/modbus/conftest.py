"""A device that drives and one that reads, at one rig."""

import json
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

from hilctl_drivers.emulator.options import EmulatorOptions
from hilctl_drivers.emulator.setup import Emulator, build
from hilctl_drivers.modbus.device import ModbusDac
from hilctl_drivers.modbus.setup import ModbusOptions
from tests.fakes import ManualClock, VirtualTime

READER = """\
vendor: nobody
model: a reader that is told when it is no longer needed
source: [this test]
verified: "yes"
link: {kind: rtu, baud: 115200}
address_base: 0
exchange: none
turnaround_s: 0.0
max_rate_hz: 1000.0
outputs: {}
inputs:
  IN: {area: input, address: 0, type: int16, scale: 0.001, unit: V, min: -10.0, max: 10.0}
  OWN: {area: input, address: 1, type: int16, scale: 0.001, unit: V, min: -10.0, max: 10.0,
        measures: output}
init:
  - {kind: write, address: 7, type: uint16, value: 1, verify: true, note: take over}
close:
  - {kind: write, address: 7, type: uint16, value: 2, note: let go}
watchdog: none
"""


@dataclass
class ServedPair:
    """Two emulated devices at one rig, and what the one that drives has put out."""

    emulator: Emulator
    clock: ManualClock
    log: Path

    def device(self, **changes) -> ModbusDac:
        options = {**self.emulator.options, "timeout_s": 2.0, **changes}
        time = VirtualTime()
        return ModbusDac(ModbusOptions.model_validate(options), sleep=time.sleep, clock=time)

    def events(self) -> list[dict]:
        return [json.loads(line) for line in self.log.read_text().splitlines()]


@pytest.fixture
def serve(tmp_path) -> Iterator[Callable[..., ServedPair]]:
    """Return a function that serves two devices on a clock that stands still."""
    started: list[tuple[ServedPair, threading.Thread]] = []

    def start(profile: str, reader: str, **options) -> ServedPair:
        clock, log = ManualClock(0), tmp_path / f"writes{len(started)}.jsonl"
        emulator = build(EmulatorOptions(profile, reader=reader, log=log, **options), clock)
        thread = threading.Thread(target=emulator.server.run)
        thread.start()
        started.append((ServedPair(emulator, clock, log), thread))
        return started[-1][0]

    yield start
    for served, thread in started:
        served.emulator.server.stop()
        thread.join()
        served.emulator.log.close()


@pytest.fixture
def reader(tmp_path) -> str:
    """A profile with init and close steps and nothing to drive, by path."""
    path = tmp_path / "reader.yaml"
    path.write_text(READER, encoding="utf-8")
    return str(path)
