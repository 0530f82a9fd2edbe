"""Serial devices on emulated ones."""

from contextlib import ExitStack

import numpy as np
import pytest

from hilctl_drivers.dac import SerialDac, SerialOptions
from hilctl_drivers.emulator.options import EmulatorOptions, parse_fault
from hilctl_drivers.profile import shipped_profiles
from hilctl_drivers.simulated.devices import TerfenolOptions
from tests.fakes import ShiftedClock, emulated, logged, one_rig

TIMEOUT_S = 1.0
"""A busy machine answers within it."""


class SerialBench:
    """A ``serial_dac`` that is wired to its emulator."""

    def __init__(self, emulator, log, clock, rate_hz, block, options):
        self.emulator, self.clock = emulator, clock
        self._log, self._rate_hz, self._block = log, rate_hz, block
        self.device = SerialDac(SerialOptions.model_validate({**emulator.options, **options}))
        self.sent = 0

    def open(self):
        self.device.open(self._rate_hz, self._block)
        self.device.arm()
        self.sent = 0

    def exchange(self, command):
        """Send one block, or one value all through it; return the displacements."""
        displacement_um, measured = np.full((2, self._block), np.nan)
        sent = np.full(self._block, command, dtype=float)
        self.device.exchange(self.sent, sent, displacement_um, measured)
        self.sent += self._block
        return displacement_um

    def pass_s(self, seconds):
        self.clock.extra_ns += round(seconds * 1e9)

    def events(self):
        return logged(self._log)

    def current_a(self):
        """What the coil carries by the emulator's log."""
        return [event["current_a"] for event in self.events() if "current_a" in event][-1]


@pytest.fixture
def no_boot(tmp_path):
    """Return a function that writes a shipped board's profile without its wait for the boot."""

    def of(name):
        text = shipped_profiles()[name].read_text()
        path = tmp_path / f"{name}.yaml"
        path.write_text(text.replace("boot_wait_s: 2.0", "boot_wait_s: 0.0"))
        return str(path)

    return of


@pytest.fixture
def serial_bench(tmp_path):
    """Return a function that wires a serial_dac to an emulator of its profile."""
    with ExitStack() as stack:
        benches = []

        def of(profile, /, *, faults=(), rate_hz=20.0, block=1, noise=True, reader=None,
               own_line=False, link=None, **options):  # fmt: skip
            log, clock = tmp_path / f"log{len(benches)}.jsonl", ShiftedClock()
            wanted = EmulatorOptions(
                profile,
                log=log,
                rigs=one_rig(actuator=TerfenolOptions(noise=noise)),
                faults=tuple(map(parse_fault, faults)),
                link=link,
                reader=reader,
                reader_line="own" if own_line else "same",
            )
            emulator = stack.enter_context(emulated(wanted, clock))
            benches.append(SerialBench(emulator, log, clock, rate_hz, block, options))
            stack.callback(benches[-1].device._release)
            return benches[-1]

        yield of
