"""Devices on emulated ones: served in a thread, and in this process."""

from contextlib import ExitStack
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from hilctl_drivers.dac import ModbusDac, ModbusOptions
from hilctl_drivers.emulator.factory import Emulator
from hilctl_drivers.emulator.options import EmulatorOptions
from hilctl_drivers.profile import shipped_profiles
from tests.fakes import FaultyLink, InProcess, ManualClock, emulated, logged

MESSAGE_S = 0.001
TIMEOUT_S = 0.1
PATIENT_S = 20.0
"""A busy machine answers within it."""
RATE_HZ = 100.0

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
init:
  - {kind: write, address: 7, type: uint16, value: 1, verify: true, note: take over}
close:
  - {kind: write, address: 7, type: uint16, value: 2, note: let go}
watchdog: none
"""


def exchange(device, value):
    """Exchange one sample; return the displacement in um."""
    displacement_um = np.full(1, np.nan)
    device.exchange(0, np.array([value]), displacement_um, np.full(1, np.nan))
    return float(displacement_um[0])


@dataclass
class Served:
    """A served device, possibly with a reader, and its log."""

    emulator: Emulator
    clock: ManualClock
    log: Path

    def device(self, **changes):
        options = {**self.emulator.options, "timeout_s": PATIENT_S, **changes}
        return ModbusDac(ModbusOptions.model_validate(options))

    def running(self, rate_hz=RATE_HZ, **changes):
        """Return a device that is open and armed."""
        device = self.device(**changes)
        device.open(rate_hz, 1)
        device.arm()
        return device

    def events(self):
        return logged(self.log)


def _limited(wire, answer, lacking, mute, request, now_ns):
    """Answer as a device that does not know some functions, or never answers some."""
    if request[3] in mute:
        return None
    return wire.refusal(request, 1) if request[3] in lacking else answer(request, now_ns)


@pytest.fixture
def serve(tmp_path):
    """Return a function that serves a device on a clock that stands still.

    It refuses the Modbus functions in ``lacking`` as unknown, and does not answer those in
    ``mute``.
    """
    log = tmp_path / "writes.jsonl"
    with ExitStack() as stack:

        def start(profile, reader=None, lacking=(), mute=(), **options):
            clock = ManualClock(0)
            chosen = EmulatorOptions(profile, reader=reader, log=log, command=0.0, **options)
            emulator = stack.enter_context(emulated(chosen, clock))
            for wire in emulator.wires:
                wire.answer = partial(_limited, wire, wire.answer, lacking, mute)
            return Served(emulator, clock, log)

        yield start


class DrivenModbus:
    """A modbus_dac that is wired to an emulated device."""

    def __init__(self, log, profile="generic_float32", link=FaultyLink, current_a=0.0, **changes):
        self._log = log
        self.emulated = InProcess.of(
            profile, link=link, log=self._log, message_s=MESSAGE_S, current_a=current_a
        )
        self.link, self.time = self.emulated.link, self.emulated.time
        self._options = {
            **self.emulated.options, "profile": profile, "timeout_s": TIMEOUT_S, **changes,
        }  # fmt: skip
        self.device = self.another()

    def another(self, **changes):
        """Return a device on the same emulated one, with other options."""
        options = ModbusOptions.model_validate({**self._options, **changes})
        return ModbusDac(options, self.link)

    def open(self):
        """Open and arm it, as a run does."""
        self.device.open(RATE_HZ, 1)
        self.device.arm()

    def exchange(self, value):
        return exchange(self.device, value)

    @property
    def current_a(self):
        """What the device puts out, with all delivered that is due."""
        self.link.deliver()
        return self.emulated.rig.command

    def writes(self):
        return logged(self._log)


@pytest.fixture
def driven(tmp_path):
    """Return a function that wires a modbus_dac to an emulated device."""
    made = []

    def of(*words, **changes):
        made.append(DrivenModbus(tmp_path / "writes.jsonl", *words, **changes))
        return made[-1]

    yield of
    for each in made:
        each.emulated.log.close()


@pytest.fixture
def variant(tmp_path):
    """Return a function that writes generic_float32 with other texts and returns the path."""

    def of(*changes):
        text = shipped_profiles()["generic_float32"].read_text(encoding="utf-8")
        for old, new in changes:
            assert old in text
            text = text.replace(old, new)
        path = tmp_path / "variant.yaml"
        path.write_text(text, encoding="utf-8")
        return str(path)

    return of


@pytest.fixture
def reader(tmp_path):
    """A profile with init and close steps and nothing to drive, by path."""
    path = tmp_path / "reader.yaml"
    path.write_text(READER, encoding="utf-8")
    return str(path)
