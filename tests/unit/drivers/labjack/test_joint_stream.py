"""Two outputs of an emulated LabJack in one scan list."""

import numpy as np
import pytest

from hilctl.base.device import joined
from hilctl_drivers.dac import ModbusStream, ModbusStreamOptions
from tests.fakes import T7_OPTIONS, InProcess

BLOCK, FIFO_BLOCKS, RATE_HZ = 20, 4, 2000.0
AXES = {"x": ("DAC0", "AIN0"), "y": ("DAC1", "AIN1")}


class Pair:
    """Two modbus_streams on an emulated T7, as x and y; ``played`` are the values it output."""

    def __init__(self, **changes):
        self.made = InProcess.of("labjack_t7", rigs=2)
        self.devices = {}
        for axis, (output, source) in AXES.items():
            options = {
                **T7_OPTIONS, "host": "h", "output": output, "input": source,
                "fifo_blocks": FIFO_BLOCKS, **changes,
            }  # fmt: skip
            made = ModbusStream(ModbusStreamOptions.model_validate(options), self.made.link)
            self.devices[axis] = made
        self.joint = joined(self.devices)["x", "y"]
        for wire in self.joint._joint.wires:
            wire.buffer.sleep, wire.buffer.clock = self.made.time.sleep, self.made.time
        self.first = 0

    def exchange(self, *commands):
        found = np.full((2, BLOCK), np.nan)
        self.joint.exchange(self.first, commands, [*found], [np.empty(BLOCK), np.empty(BLOCK)])
        self.first += BLOCK
        return found


def test_both_outputs_change_in_the_same_scan():
    pair = Pair()
    pair.joint.open(RATE_HZ, BLOCK)
    assert {each.info.details["transactions"] for each in pair.devices.values()} == {"2"}
    stream = pair.made.device.overlay
    played, on_played = {}, stream._on_played

    def noting(name, first, command, now_ns):
        played.setdefault(name, []).append((first, command))
        on_played(name, first, command, now_ns)

    stream._on_played = noting
    steps = np.arange(400.0).reshape(-1, BLOCK)
    for block in steps:
        found = pair.exchange(np.where(block < 150, -1.0, 2.0), np.where(block < 150, 3.0, -4.0))
    assert np.isfinite(found).all()
    jumps = []
    for parts in played.values():
        values = np.concatenate([command for _, command in parts])
        jumps.append(parts[0][0] + np.flatnonzero(np.abs(np.diff(values)) > 1.0)[-1])
    assert jumps[0] == jumps[1]
    pair.joint.close()


def test_inputs_are_read_in_the_same_scan():
    """Both rigs are alike: equal commands give equal readings, sample by sample."""
    pair = Pair()
    pair.joint.open(RATE_HZ, BLOCK)
    block = np.linspace(-2.0, 2.0, BLOCK)
    for _ in range(10):
        found = pair.exchange(block, block)
    np.testing.assert_allclose(found[0], found[1], atol=0.01)
    pair.joint.close()


def test_rate_is_that_of_all_addresses_of_the_scan_list():
    pair = Pair(aux={"coil_v": {"input": "AIN2"}})
    assert pair.joint.max_rate_hz <= 100_000 / 5  # two outputs, two inputs, one shared channel
    assert pair.joint._joint.wires[0].rates(400).highest_hz > pair.joint.max_rate_hz


@pytest.mark.parametrize("closed", [False, True])
def test_each_output_is_made_safe(closed):
    pair = Pair()
    pair.joint.open(RATE_HZ, BLOCK)
    for _ in range(10):
        pair.exchange(np.full(BLOCK, 2.0), np.full(BLOCK, -3.0))
    if closed:
        pair.joint.close()
    values = {"x": 0.0, "y": 1.0}
    for axis, value in values.items():
        pair.devices[axis].make_safe(value)
    for axis, value in values.items():
        assert pair.devices[axis].look().output == pytest.approx(value, abs=0.01)
