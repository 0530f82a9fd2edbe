"""The device contract of ``modbus_stream`` for each profile that can stream.

Virtual time advances with messages and waits.
"""

import numpy as np
import pytest

from hilctl.base.errors import DeviceError
from hilctl.experiment.devices import device_class
from hilctl_drivers.contract import *  # noqa: F403  the checks, and the fixture driven
from hilctl_drivers.contract import DrivenDevice
from hilctl_drivers.modbus.modbus_profile import ModbusProfile
from hilctl_drivers.profile import load_profile, shipped_profiles
from tests.fakes import InProcess

RATE_HZ = 10_000.0
BLOCK = 50
FIFO_BLOCKS = 3
LATE = FIFO_BLOCKS * BLOCK
STREAMING = ("labjack_t4", "labjack_t7")
"""The shipped profiles that stream over Modbus."""


class DrivenStream(DrivenDevice):
    """A closed device and its emulation."""

    def __init__(self, profile):
        self.emulated = InProcess.of(profile, message_s=0.0002)
        chosen = device_class("modbus_stream")
        options = {**self.emulated.options, "profile": profile, "fifo_blocks": FIFO_BLOCKS}
        device = self.emulated.stream(chosen.Options.model_validate(options))
        super().__init__(device, BLOCK, RATE_HZ, lambda: self.current_a, name="modbus_stream")

    @property
    def current_a(self):
        return self.emulated.rig.command

    def exchange(self, command):
        """Exchange whole blocks, holding the last command until all answers have arrived."""
        size = len(command)
        sent = np.concatenate((command, np.full(-size % BLOCK + LATE, command[-1])))
        before = sent.copy()
        answers = super().exchange(sent)
        assert np.array_equal(sent, before)
        return tuple(values[LATE : LATE + size] for values in answers)


@pytest.fixture
def make():
    """Return a factory of devices, which are closed afterwards."""
    made = []

    def of(profile):
        made.append(DrivenStream(profile))
        return made[-1]

    yield of
    for each in made:
        each.device.close()


@pytest.fixture(params=STREAMING)
def case(request):
    return request.param


def test_no_streaming_profile_is_left_out():
    shipped = {name: load_profile(name) for name in shipped_profiles()}
    assert {
        name
        for name, each in shipped.items()
        if isinstance(each, ModbusProfile) and each.streaming != "none"
    } == set(STREAMING)


def test_info_of_a_stream(driven):
    info = driven.device.info
    assert info.buffered
    assert info.fifo_depth > 0
    assert info.latency_blocks == FIFO_BLOCKS
    assert info.holds == ("tcp:127.0.0.1:502",)
    assert driven.emulated.link.requests == []


def test_displacements_come_that_many_blocks_later(driven):
    driven.open()
    n, info = 10 * BLOCK, driven.device.info
    displacement_um, measured = DrivenDevice.exchange(driven, np.linspace(0.0, driven.middle, n))
    assert np.isnan(displacement_um[:LATE]).all()
    assert np.isfinite(displacement_um[LATE:]).all()
    assert (displacement_um[LATE:] >= info.sensor_min_um).all()
    assert (displacement_um[LATE:] <= info.sensor_max_um).all()
    assert np.isnan(measured).all()


def test_a_block_of_another_size_is_refused(driven):
    driven.open()
    with pytest.raises(DeviceError, match="50 samples"):
        DrivenDevice.exchange(driven, np.zeros(BLOCK - 1))


def test_the_output_persists_exactly_and_is_read_back(driven):
    driven.open()
    driven.exchange(np.full(10 * BLOCK, driven.middle))
    held = driven.current_a
    driven.device.close()
    driven.open()
    driven.emulated.time.sleep(1.0)
    assert driven.current_a == held == pytest.approx(driven.middle, abs=1e-6)
    assert driven.device.output() == pytest.approx(driven.middle, abs=1e-6)


def test_queued_samples_are_not_output_after_make_safe(driven):
    safe = 0.5 * driven.middle
    driven.device.make_safe(safe)
    assert driven.current_a == pytest.approx(safe, abs=1e-6)
    driven.open()
    DrivenDevice.exchange(driven, np.full(6 * BLOCK, driven.middle))
    assert driven.current_a == pytest.approx(driven.middle, abs=1e-6)
    driven.device.make_safe(safe)
    assert driven.current_a == pytest.approx(safe, abs=1e-6)
    driven.emulated.time.sleep(1.0)
    driven.emulated.device.tick(driven.emulated.time.now_ns)
    driven.device.close()
    assert driven.current_a == pytest.approx(safe, abs=1e-6)
    driven.device.make_safe(0.0)
    assert driven.current_a == pytest.approx(0.0, abs=1e-6)
