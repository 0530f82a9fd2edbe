"""Crosstalk between simulated devices, exchanged as one."""

import numpy as np
import pytest

from hilctl.base.device import joined
from hilctl.base.errors import DeviceError
from hilctl_drivers.simulated.crosstalk import Crosstalk
from hilctl_drivers.simulated.devices import (
    PiezoOptions,
    SimulatedPiezo,
    SimulatedTerfenol,
    TerfenolOptions,
)

RATE_HZ, BLOCK = 50e3, 50


def pair(x=None, y=None, **options):
    """Return a Terfenol and a piezo axis without noise; x and y are the crosstalk into them."""
    return {
        "x": SimulatedTerfenol(TerfenolOptions(noise=False, crosstalk=x or {}, **options)),
        "y": SimulatedPiezo(PiezoOptions(noise=False, crosstalk=y or {})),
    }


def joint_of(devices):
    (unit,) = joined(devices).values()
    return unit


def moved(unit, x=0.0, y=0.0, blocks=40, block=BLOCK):
    """Return the readings of both axes for sines of these amplitudes about 3 A and 50 V."""
    unit.open(RATE_HZ, block)
    found = []
    for k in range(blocks):
        t = np.arange(k * block, (k + 1) * block) / RATE_HZ
        commands = [3.0 * x * np.sin(628.0 * t), 50.0 + 20.0 * y * np.sin(628.0 * t)]
        readings = [np.empty(block), np.empty(block)]
        unit.exchange(k * block, commands, readings, [np.empty(block), np.empty(block)])
        found.append(readings)
    unit.close()
    return np.concatenate(found, axis=1)


def test_devices_join_only_if_one_sees_another():
    assert len(joined(pair())) == 2
    assert [*joined(pair(x={"y": Crosstalk(gain=0.1)}))] == [("x", "y")]
    assert [*joined(pair(y={"x": Crosstalk(gain=0.1)}))] == [("x", "y")]


def test_static_crosstalk_is_a_share_of_the_own_displacement():
    own = moved(joint_of(pair(x={"y": Crosstalk(gain=0.0)})), x=1.0, y=1.0)
    seen = moved(joint_of(pair(x={"y": Crosstalk(gain=0.1)})), x=1.0, y=1.0)
    np.testing.assert_allclose(seen[0] - own[0], 0.1 * own[1], atol=0.01)  # codes of 4 nm and 1 nm
    np.testing.assert_array_equal(seen[1], own[1])


def test_devices_without_crosstalk_have_the_bits_of_their_own_runs():
    joint = moved(joint_of(pair(x={"y": Crosstalk(gain=0.0)})), x=1.0)
    alone = pair()["x"]
    alone.open(RATE_HZ, BLOCK)
    reading = np.empty(BLOCK)
    for k in range(40):
        t = np.arange(k * BLOCK, (k + 1) * BLOCK) / RATE_HZ
        alone.exchange(k * BLOCK, 3.0 * np.sin(628.0 * t), reading, np.empty(BLOCK))
        np.testing.assert_array_equal(joint[0][k * BLOCK :][:BLOCK], reading)


@pytest.mark.parametrize("damping_ratio", [0.05, 0.3])
def test_mode_amplifies_at_its_frequency(damping_ratio):
    path = Crosstalk(gain=0.04, natural_hz=200.0, damping_ratio=damping_ratio).path(RATE_HZ)
    t = np.arange(50_000) / RATE_HZ
    steady = [np.abs(path(np.sin(2.0 * np.pi * hz * t)))[25_000:].max() for hz in (2.0, 200.0)]
    path(np.zeros(1))
    assert steady[1] / 0.04 == pytest.approx(0.5 / damping_ratio, rel=0.05)


def test_readings_do_not_depend_on_the_blocks():
    mode = {"x": Crosstalk(gain=0.05, natural_hz=300.0)}
    long = moved(joint_of(pair(y=mode)), x=1.0, y=0.5, blocks=2, block=4000)
    short = moved(joint_of(pair(y=mode)), x=1.0, y=0.5, blocks=160)
    np.testing.assert_array_equal(long, short)


def test_skipped_samples_pass_on_all_axes():
    unit = joint_of(pair(x={"y": Crosstalk(gain=0.1)}))
    unit.open(RATE_HZ, 1)

    def read(first):
        readings = [np.empty(1), np.empty(1)]
        unit.exchange(first, [np.zeros(1), np.full(1, 80.0)], readings, [np.empty(1), np.empty(1)])
        return readings

    assert read(0)[0] == 0.0
    x, y = read(1000)
    assert x == pytest.approx(0.1 * y, abs=0.01)
    assert y > 5.0


def test_an_invalid_command_moves_no_axis():
    unit = joint_of(pair(x={"y": Crosstalk(gain=0.1)}))
    unit.open(RATE_HZ, 1)
    out = [np.full(1, -1.0), np.full(1, -1.0)]
    with pytest.raises(DeviceError, match="simulated_piezo"):
        unit.exchange(0, [np.zeros(1), np.full(1, 1e4)], out, [np.empty(1), np.empty(1)])
    assert [each.item() for each in out] == [-1.0, -1.0]


def test_fault_of_one_axis_ends_the_exchange():
    fault = {"kind": "no_answer", "at_sample": 100}
    devices = pair(x={"y": Crosstalk(gain=0.1)}, fault=fault)
    with pytest.raises(DeviceError, match="injected"):
        moved(joint_of(devices))
