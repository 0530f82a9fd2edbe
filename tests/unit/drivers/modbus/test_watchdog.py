"""A watchdog on the module that drives is fed by writes, not by reads of another."""

import json
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from hilctl.base.errors import DeviceError
from hilctl_drivers.emulator.options import EmulatorOptions
from hilctl_drivers.emulator.setup import Emulator, build
from hilctl_drivers.modbus.device import ModbusDac
from hilctl_drivers.modbus.setup import ModbusOptions

"""Of an M-7024's output."""
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


class Clock:
    """Time that passes when told to."""

    def __init__(self) -> None:
        self.now_ns = 0

    def __call__(self) -> int:
        return self.now_ns

    def pass_s(self, seconds: float) -> None:
        self.now_ns += round(seconds * 1e9)


@dataclass
class Served:
    """Two emulated devices at one rig, and what the one that drives has put out."""

    emulator: Emulator
    clock: Clock
    log: Path

    def device(self, **changes) -> ModbusDac:
        options = {**self.emulator.options, "timeout_s": 2.0, **changes}
        return ModbusDac(ModbusOptions.model_validate(options))

    def events(self) -> list[dict]:
        return [json.loads(line) for line in self.log.read_text().splitlines()]


@pytest.fixture
def serve(tmp_path) -> Iterator[Callable[..., Served]]:
    """Return a function that serves two devices on a clock that stands still."""
    started: list[tuple[Served, threading.Thread]] = []

    def start(profile: str, reader: str, **options) -> Served:
        clock, log = Clock(), tmp_path / f"writes{len(started)}.jsonl"
        emulator = build(EmulatorOptions(profile, reader=reader, log=log, **options), clock)
        thread = threading.Thread(target=emulator.server.run)
        thread.start()
        started.append((Served(emulator, clock, log), thread))
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


def exchange(device: ModbusDac, value: float) -> float:
    displacement_um = np.full(1, np.nan)
    device.exchange(0, np.array([value]), displacement_um, np.full(1, np.nan))
    return float(displacement_um[0])


class TestWatchdog:
    """The watchdog belongs to the device that drives."""

    def test_writes_feed_it(self, serve):
        """Samples keep it quiet, though every second request is for the reader; silence trips."""
        served = serve("icp_m7024", "icp_m7017")
        device = served.device(watchdog={"timeout_s": 1.0})
        device.open(5.0, 1)
        for _ in range(6):
            served.clock.pass_s(0.5)
            exchange(device, 2.0)
        assert not served.emulator.device.tripped
        served.clock.pass_s(1.5)
        with pytest.raises(DeviceError, match="exception 4"):
            exchange(device, 2.0)
        assert served.emulator.device.tripped
