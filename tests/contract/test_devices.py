"""The contract of every device that hilctl ships: the same tests for each."""

import numpy as np
import pytest

from hilctl.errors import DeviceError
from hilctl.registry import BUILTIN, device_class

RATE_HZ = 10_000.0
BLOCK = 20


@pytest.fixture(params=sorted(BUILTIN))
def device(request):
    """A device with its default options, closed afterwards."""
    chosen = device_class(request.param)
    made = chosen(chosen.Options())
    yield made
    made.close()


def exchange(device, first, command):
    command = np.asarray(command, dtype=np.float64)
    displacement_um, measured = np.full(command.size, np.nan), np.full(command.size, np.nan)
    device.exchange(first, command, displacement_um, measured)
    return displacement_um, measured


def middle(device):
    """A command well inside the range that is not the resting one."""
    info = device.info
    return 0.5 * (info.command_max + max(0.0, info.command_min))


def test_says_what_it_is_before_it_is_opened(device):
    """Info is complete and sensible without a connection."""
    info = device.info
    assert info.name in BUILTIN
    assert info.description
    assert info.command_unit in {"A", "V"}
    assert info.command_min < info.command_max
    assert info.sensor_min_um < info.sensor_max_um
    assert info.max_rate_hz >= RATE_HZ
    assert info.buffered == (info.fifo_depth > 0)
    assert all(isinstance(text, str) for text in info.details.values())


def test_exchanges_blocks(device):
    """Every displacement is filled with a number in the sensor's range, and commands move it."""
    device.open(RATE_HZ, BLOCK)
    info = device.info
    rest, _ = exchange(device, 0, np.zeros(BLOCK))
    ramp = np.linspace(0.0, middle(device), BLOCK)
    exchange(device, BLOCK, ramp)
    moved, measured = exchange(device, 2 * BLOCK, np.full(BLOCK, ramp[-1]))
    for values in (rest, moved):
        assert np.isfinite(values).all()
        assert (values >= info.sensor_min_um).all()
        assert (values <= info.sensor_max_um).all()
    assert moved[-1] > rest.max() + 1.0
    assert np.isfinite(measured).all() == info.measures_command


def test_displacement_is_sampled_before_the_command_acts(device):
    """The first sample after a jump still shows the rest; a later one does not."""
    device.open(RATE_HZ, BLOCK)
    rest, _ = exchange(device, 0, np.zeros(BLOCK))
    moved, _ = exchange(device, BLOCK, np.full(BLOCK, middle(device)))
    assert abs(moved[0] - rest.mean()) < 0.5
    assert moved[-1] > rest.mean() + 1.0


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf, "above", "below"])
def test_refuses_what_it_can_not_do(device, bad):
    """A value that is not finite or out of range is refused whole: nothing of the block is sent."""
    device.open(RATE_HZ, BLOCK)
    info = device.info
    value = {"above": info.command_max * 1.001 + 1e-6, "below": info.command_min * 1.001 - 1e-6}
    command = np.full(BLOCK, middle(device))
    command[BLOCK // 2] = value.get(bad, bad) if isinstance(bad, str) else bad
    with pytest.raises(DeviceError, match=info.name):
        exchange(device, 0, command)
    after, _ = exchange(device, 0, np.zeros(BLOCK))
    assert np.abs(after).max() < 0.5


def test_takes_its_whole_range(device):
    """Both ends of the stated range are accepted."""
    device.open(RATE_HZ, BLOCK)
    for k, value in enumerate((device.info.command_min, device.info.command_max)):
        exchange(device, k * BLOCK, np.full(BLOCK, value))


def test_does_not_change_the_command(device):
    """The command array is read, never written."""
    device.open(RATE_HZ, BLOCK)
    command = np.linspace(0.0, middle(device), BLOCK)
    before = command.copy()
    exchange(device, 0, command)
    assert np.array_equal(command, before)


def test_use_before_open_and_after_close_is_refused(device):
    """Exchange needs an open device; closing twice is fine."""
    with pytest.raises(DeviceError):
        exchange(device, 0, np.zeros(BLOCK))
    device.open(RATE_HZ, BLOCK)
    device.close()
    device.close()
    with pytest.raises(DeviceError):
        exchange(device, 0, np.zeros(BLOCK))


def test_rate_beyond_its_limit_is_refused(device):
    """A sample rate that it can't keep is refused at open."""
    with pytest.raises(DeviceError):
        device.open(device.info.max_rate_hz * 1.01, BLOCK)


def test_make_safe_works_open_or_closed(device):
    """The last resort needs no open connection."""
    device.make_safe(0.0)
    device.open(RATE_HZ, BLOCK)
    exchange(device, 0, np.full(BLOCK, middle(device)))
    device.make_safe(0.0)
    device.close()
    device.make_safe(0.0)


def test_two_of_a_kind_agree(device):
    """A second one with the same options gives the same bits: runs can be repeated."""
    chosen = device_class(device.info.name)
    other = chosen(chosen.Options())
    command = np.linspace(0.0, middle(device), BLOCK)
    results = []
    for each in (device, other):
        each.open(RATE_HZ, BLOCK)
        results.append(exchange(each, 0, command)[0])
    other.close()
    assert np.array_equal(*results)
