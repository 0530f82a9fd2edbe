"""The simulated rig behind an emulated device, with the time in the test's hand."""

import numpy as np
import pytest

from hilctl_drivers.emulator.rig import RATE_HZ, SampleFifo, Stage
from hilctl_drivers.simulated.crosstalk import Crosstalk
from hilctl_drivers.simulated.devices import SimulatedTerfenol, TerfenolOptions
from hilctl_drivers.simulated.terfenol import TerfenolActuator, TerfenolParameters
from tests.unit.drivers.emulator.conftest import MS

TERFENOL = SimulatedTerfenol(TerfenolOptions())
QUIET = SimulatedTerfenol(TerfenolOptions(noise=False))


def test_is_the_actuator_on_its_own_clock():
    stage = Stage(5 * MS, {"": TERFENOL})
    (rig,) = stage.rigs
    rig.put_out(3.0, 5 * MS)
    shown = []
    for k in range(1, 200):
        stage.advance(5 * MS + k * 137_000)
        shown.append(rig.displacement_um)
    plant = TerfenolActuator(TerfenolParameters(), RATE_HZ)
    command = np.concatenate([np.zeros(1), np.full(400, 3.0)])
    read = np.empty((2, command.size))
    plant.step(command, read[0], read[1])
    due = [int(k * 137_000 * 1e-9 * RATE_HZ) for k in range(1, 200)]
    assert shown == [read[0, max(0, k - 1)] for k in due]


SEEN = {"y": Crosstalk(gain=0.1, natural_hz=300.0)}


def crosstalk_stage():
    """A stage with a rig at rest whose sensor sees the rig of y."""
    x = SimulatedTerfenol(TerfenolOptions(noise=False, crosstalk=SEEN))
    return Stage(0, {"x": x, "y": QUIET})


def test_a_sensor_sees_another_rig():
    stage = crosstalk_stage()
    x, y = stage.rigs
    y.put_out(3.0, 0)
    shown = []
    for k in range(1, 30):
        stage.advance(k * 10 * MS)
        shown.append((x.displacement_um, y.displacement_um))
    y_um = shown[-1][1]
    assert y_um > 5.0
    assert shown[-1][0] == pytest.approx(0.1 * y_um, rel=0.01)


def test_a_sensor_sees_another_rig_in_a_stream():
    """As the same plants advanced together at the rate of the stream."""
    stage, played = crosstalk_stage(), []
    fifo = SampleFifo(stage, repeats=True, on_played=lambda *found: played.append(found))
    commands = np.zeros(60), np.linspace(0.0, 3.0, 60)
    for queue, command in zip(fifo.queues, commands, strict=True):
        queue.put(command)
    fifo.set_rate(1000.0)
    fifo.start(0)
    for now_ms in (7, 60):
        fifo.advance(now_ms * MS)
    assert [found[0] for found in played] == [0, 7]
    plants = stage.plants(1000.0)
    plants.hold(100, [0.0, 0.0])
    read_um, read = np.empty((2, 2, 60))
    plants.step(commands, [*read_um], [*read])
    for number in range(2):
        shown_um = np.concatenate([found[2][number] for found in played])
        assert shown_um.tolist() == read_um[number].tolist()
    assert np.abs(read_um[0]).max() > 0.5


def test_long_silence_costs_no_more_than_settling():
    stage = Stage(0, {"": QUIET})
    (rig,) = stage.rigs
    rig.put_out(2.0, 0)
    stage.advance(24 * 3600 * 1000 * MS)
    settled = rig.displacement_um
    stage.advance(25 * 3600 * 1000 * MS)
    assert rig.displacement_um == pytest.approx(settled, abs=1e-2)


class Record:
    """A FIFO at 1 kHz that starts at time 0, and what it put out and read."""

    def __init__(self, *, repeats):
        self.firsts, self.commands, self.displacement_um = [], [], []
        self.fifo = SampleFifo(Stage(0, {"": QUIET}), repeats=repeats, on_played=self._played)
        (self.queue,) = self.fifo.queues
        self.fifo.set_rate(1000.0)
        self.fifo.start(0)

    def _played(self, first, commands, displacements_um, now_ns):
        self.firsts.append(first)
        self.commands += commands[0].tolist()
        self.displacement_um += displacements_um[0].tolist()


@pytest.mark.parametrize("repeats", [True, False])
def test_each_value_is_put_out_once(repeats):
    record = Record(repeats=repeats)
    commands = np.linspace(0.0, 3.0, 60)
    for part in np.array_split(commands, 7):
        record.queue.put(part)
    for now_ms in (3, 4, 11, 30, 31, 59, 60):
        record.fifo.advance(now_ms * MS)
        assert record.queue.level == 60 - now_ms
    assert record.firsts == [0, 3, 4, 11, 30, 31, 59]
    assert record.commands == commands.tolist()
    assert len(record.displacement_um) == 60
    assert (np.diff(record.displacement_um) > -1e-2).all()
    assert (record.fifo.played, record.fifo.underruns) == (60, 0)


def test_a_stop_keeps_the_queue_and_the_output():
    """Until it is cleared; a new rate counts from 0."""
    record = Record(repeats=True)
    record.queue.put(np.array([1.0, 2.0]))
    record.fifo.advance(MS)
    record.fifo.stop()
    record.fifo.advance(9 * MS)
    assert (record.queue.level, record.queue.command, record.fifo.running) == (1, 1.0, False)
    record.fifo.set_rate(2000.0)
    record.fifo.start(10 * MS)
    record.fifo.advance(10 * MS + MS // 2)
    assert record.firsts == [0, 0]
    assert record.commands == [1.0, 2.0]
