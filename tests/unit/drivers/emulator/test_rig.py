"""The simulated rig behind an emulated device, with the time in the test's hand."""

import numpy as np
import pytest

from hilctl_drivers.emulator.rig import RATE_HZ, Rig, SampleFifo
from hilctl_drivers.simulated.devices import SimulatedTerfenol, TerfenolOptions
from hilctl_drivers.simulated.terfenol import TerfenolActuator, TerfenolParameters
from tests.unit.drivers.emulator.conftest import MS

TERFENOL = SimulatedTerfenol(TerfenolOptions())
QUIET = SimulatedTerfenol(TerfenolOptions(noise=False))


def test_is_the_actuator_on_its_own_clock():
    rig = Rig(5 * MS, TERFENOL)
    rig.put_out(3.0, 5 * MS)
    shown = []
    for k in range(1, 200):
        rig.advance(5 * MS + k * 137_000)
        shown.append(rig.displacement_um)
    plant = TerfenolActuator(TerfenolParameters(), RATE_HZ)
    command = np.concatenate([np.zeros(1), np.full(400, 3.0)])
    read = np.empty((2, command.size))
    plant.step(command, read[0], read[1])
    due = [int(k * 137_000 * 1e-9 * RATE_HZ) for k in range(1, 200)]
    assert shown == [read[0, max(0, k - 1)] for k in due]


def test_long_silence_costs_no_more_than_settling():
    rig = Rig(0, QUIET)
    rig.put_out(2.0, 0)
    rig.advance(24 * 3600 * 1000 * MS)
    settled = rig.displacement_um
    rig.advance(25 * 3600 * 1000 * MS)
    assert rig.displacement_um == pytest.approx(settled, abs=1e-2)


class Record:
    """A FIFO at 1 kHz that starts at time 0, and what it put out and read."""

    def __init__(self, *, repeats):
        self.firsts, self.commands, self.displacement_um = [], [], []
        self.fifo = SampleFifo(QUIET, repeats=repeats, on_played=self._played)
        self.fifo.set_rate(1000.0)
        self.fifo.start(0)

    def _played(self, first, command, displacement_um, now_ns):
        self.firsts.append(first)
        self.commands += command.tolist()
        self.displacement_um += displacement_um.tolist()


@pytest.mark.parametrize("repeats", [True, False])
def test_each_value_is_put_out_once(repeats):
    record = Record(repeats=repeats)
    commands = np.linspace(0.0, 3.0, 60)
    for part in np.array_split(commands, 7):
        record.fifo.queue(part)
    for now_ms in (3, 4, 11, 30, 31, 59, 60):
        record.fifo.advance(now_ms * MS)
        assert record.fifo.level == 60 - now_ms
    assert record.firsts == [0, 3, 4, 11, 30, 31, 59]
    assert record.commands == commands.tolist()
    assert len(record.displacement_um) == 60
    assert (np.diff(record.displacement_um) > -1e-2).all()
    assert (record.fifo.played, record.fifo.underruns) == (60, 0)


def test_a_stop_keeps_the_queue_and_the_output():
    """Until it is cleared; a new rate counts from 0."""
    record = Record(repeats=True)
    record.fifo.queue(np.array([1.0, 2.0]))
    record.fifo.advance(MS)
    record.fifo.stop()
    record.fifo.advance(9 * MS)
    assert (record.fifo.level, record.fifo.command, record.fifo.running) == (1, 1.0, False)
    record.fifo.set_rate(2000.0)
    record.fifo.start(10 * MS)
    record.fifo.advance(10 * MS + MS // 2)
    assert record.firsts == [0, 0]
    assert record.commands == [1.0, 2.0]
