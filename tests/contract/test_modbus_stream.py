"""The contract of ``modbus_stream``, the part of it that streams have, for each profile that can.

Time is the test's own: it passes by the messages and by what the device waits.
"""

import numpy as np
import pytest

from hilctl.base.errors import DeviceError
from hilctl.experiment.device import device_class
from hilctl_drivers.modbus.modbus_profile import ModbusProfile
from hilctl_drivers.profile import load_profile, shipped_profiles
from tests.fakes import InProcess

RATE_HZ = 10_000.0
BLOCK = 50
FIFO_BLOCKS = 3
STREAMING = ("labjack_t4", "labjack_t7")
"""The shipped profiles that stream over Modbus."""


class DrivenStream:
    """A device that was not opened yet, and how to use it."""

    def __init__(self, profile):
        self.profile = profile
        self.emulated = InProcess.of(profile, message_s=0.0002)
        wiring = self.emulated.device.wiring
        chosen = device_class("modbus_stream")
        options = {
            "profile": profile,
            "host": "127.0.0.1",
            "output": next(iter(self.emulated.device.profile.outputs)),
            "input": next(iter(self.emulated.device.profile.inputs)),
            "amplifier": {"gain_a_per_v": wiring.gain_a, "offset_a": wiring.offset_a},
            "sensor": {"um_per_v": wiring.sensor_um, "offset_um": wiring.offset_um},
            "watchdog": "none",
            "fifo_blocks": FIFO_BLOCKS,
        }
        self.device = chosen(
            chosen.Options.model_validate(options),
            connect=lambda peer: peer.session(self.emulated.link),
            sleep=self.emulated.time.sleep,
            clock=self.emulated.time,
        )
        info = self.device.info
        self.middle = 0.5 * (info.command_max + max(0.0, info.command_min))

    def open(self):
        self.device.open(RATE_HZ, BLOCK)
        self.device.arm()

    def exchange(self, first, command):
        """Exchange any number of samples, a block at a time."""
        command = np.asarray(command, dtype=np.float64)
        displacement_um, measured = np.full(command.size, np.nan), np.full(command.size, np.nan)
        for start in range(0, command.size, BLOCK):
            part = slice(start, start + BLOCK)
            self.device.exchange(
                first + start, command[part], displacement_um[part], measured[part]
            )
        return displacement_um, measured


@pytest.fixture(params=STREAMING)
def driven(request):
    """A device on an emulated one, for each profile."""
    made = DrivenStream(request.param)
    yield made
    made.device.close()


def test_no_streaming_profile_is_left_out():
    """Each shipped profile that streams over Modbus meets its own emulation."""
    shipped = {name: load_profile(name) for name in shipped_profiles()}
    assert {
        name
        for name, each in shipped.items()
        if isinstance(each, ModbusProfile) and each.streaming != "none"
    } == set(STREAMING)


def test_says_what_it_is_before_it_is_opened(driven):
    """Info is complete and sensible without a connection."""
    info = driven.device.info
    assert info.name == "modbus_stream"
    assert info.buffered
    assert info.fifo_depth > 0
    assert info.latency_blocks == FIFO_BLOCKS
    assert info.holds == ("tcp:127.0.0.1:502",)
    assert info.command_min < info.command_max
    assert info.sensor_min_um < info.sensor_max_um
    assert all(isinstance(text, str) for text in info.details.values())
    assert driven.emulated.link.requests == []


def test_displacements_come_that_many_blocks_later(driven):
    """The first exchanges leave their arrays alone; then each sample has its displacement."""
    driven.open()
    n, info = 10 * BLOCK, driven.device.info
    displacement_um, measured = driven.exchange(0, np.linspace(0.0, driven.middle, n))
    late = FIFO_BLOCKS * BLOCK
    assert np.isnan(displacement_um[:late]).all()
    assert np.isfinite(displacement_um[late:]).all()
    assert (displacement_um[late:] >= info.sensor_min_um).all()
    assert (displacement_um[late:] <= info.sensor_max_um).all()
    assert np.isnan(measured).all()


def test_displacement_is_sampled_before_the_command_acts(driven):
    """The sample of a jump still shows the rest; a later one does not."""
    driven.open()
    command = np.zeros(10 * BLOCK)
    command[2 * BLOCK :] = driven.middle
    found = driven.exchange(0, command)[0][FIFO_BLOCKS * BLOCK :]
    assert abs(found[2 * BLOCK]) < 0.5
    assert found[2 * BLOCK + 20] > 1.0


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf, "above", "below"])
def test_refuses_what_it_can_not_do(driven, bad):
    """A value that is not finite or out of range is refused whole: nothing of the block is sent."""
    driven.open()
    info = driven.device.info
    value = {"above": info.command_max * 1.001 + 1e-6, "below": info.command_min * 1.001 - 1e-6}
    command = np.full(BLOCK, driven.middle)
    command[BLOCK // 2] = value.get(bad, bad) if isinstance(bad, str) else bad
    with pytest.raises(DeviceError, match=info.name):
        driven.exchange(0, command)
    after, _ = driven.exchange(0, np.zeros(6 * BLOCK))
    assert np.abs(after[FIFO_BLOCKS * BLOCK :]).max() < 0.5


def test_takes_its_whole_range_and_leaves_the_command_alone(driven):
    """Both ends of the stated range are accepted, and the array is not written."""
    driven.open()
    info = driven.device.info
    command = np.linspace(info.command_min, info.command_max, 4 * BLOCK)
    before = command.copy()
    driven.exchange(0, command)
    assert np.array_equal(command, before)


def test_use_before_open_and_after_close_is_refused(driven):
    """Exchange needs an open device; closing twice is fine, and opening again too."""
    with pytest.raises(DeviceError):
        driven.exchange(0, np.zeros(BLOCK))
    driven.open()
    driven.device.close()
    driven.device.close()
    with pytest.raises(DeviceError):
        driven.exchange(0, np.zeros(BLOCK))
    driven.open()
    driven.exchange(0, np.zeros(5 * BLOCK))


def test_a_block_of_another_size_is_refused(driven):
    """Its size was agreed at open."""
    driven.open()
    with pytest.raises(DeviceError, match="50 samples"):
        driven.exchange(0, np.zeros(BLOCK - 1))


def test_opening_does_not_move_the_output(driven):
    """What was put out before stays through closing and opening."""
    driven.open()
    driven.exchange(0, np.full(10 * BLOCK, driven.middle))
    held = driven.emulated.rig.current_a
    driven.device.close()
    driven.open()
    driven.emulated.time.sleep(1.0)
    assert driven.emulated.rig.current_a == held != 0.0


def test_rate_beyond_its_limit_is_refused(driven):
    """A sample rate that it can't keep is refused at open."""
    with pytest.raises(DeviceError):
        driven.device.open(driven.device.info.max_rate_hz * 1.01, BLOCK)


def test_make_safe_works_open_or_closed(driven):
    """The last resort needs no open connection, and what is queued is not put out after it."""
    rig, safe = driven.emulated.rig, 0.5 * driven.middle
    driven.device.make_safe(safe)
    assert rig.current_a == pytest.approx(safe, abs=1e-6)
    driven.open()
    driven.exchange(0, np.full(6 * BLOCK, driven.middle))
    assert rig.current_a == pytest.approx(driven.middle, abs=1e-6)
    driven.device.make_safe(safe)
    assert rig.current_a == pytest.approx(safe, abs=1e-6)
    driven.emulated.time.sleep(1.0)
    driven.emulated.device.tick(driven.emulated.time.now_ns)
    driven.device.close()
    assert rig.current_a == pytest.approx(safe, abs=1e-6)
    driven.device.make_safe(0.0)
    assert rig.current_a == pytest.approx(0.0, abs=1e-6)


def test_says_what_it_puts_out(driven):
    """After opening it knows what stands there."""
    with pytest.raises(DeviceError):
        driven.device.output()
    driven.open()
    driven.exchange(0, np.full(10 * BLOCK, driven.middle))
    driven.device.close()
    driven.open()
    assert driven.emulated.rig.current_a == pytest.approx(driven.middle, abs=1e-6)
    assert driven.device.output() == pytest.approx(driven.middle, abs=1e-6)


def test_two_of_a_kind_agree(driven):
    """A second one with the same options gives the same bits: runs can be repeated."""
    other = DrivenStream(driven.profile)
    command = np.linspace(0.0, driven.middle, 8 * BLOCK)
    results = []
    for each in (driven, other):
        each.open()
        results.append(each.exchange(0, command)[0])
    assert np.array_equal(*results, equal_nan=True)
