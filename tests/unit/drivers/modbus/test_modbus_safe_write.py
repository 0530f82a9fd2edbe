"""The safe write against an emulated device in this process, in a time that tests make pass."""

import pytest

from hilctl.base.errors import DeviceError
from hilctl_drivers.emulator.options import EmulatorOptions
from hilctl_drivers.modbus.config import ModbusOptions
from hilctl_drivers.modbus.modbus_dac import ModbusDac
from tests.fakes import FaultyLink, emulated, made_safe

MESSAGE_S = 0.001
TIMEOUT_S = 0.1
RATE_HZ = 100.0


def test_safe_value_is_sent_first(driven):
    """The first message is the write; the other one reads it back."""
    made = driven()
    made.open()
    made.exchange(3.0)
    made.link.late_s = 0.5
    with pytest.raises(DeviceError):
        made.exchange(4.0)
    before_s, sent = made.time(), len(made.link.requests)
    made.device.make_safe(-1.0)
    first = next(each for each in made.writes() if each["current_a"] == pytest.approx(-1.0))
    assert first["monotonic_ns"] * 1e-9 - before_s == pytest.approx(MESSAGE_S)
    assert made.time() - before_s == pytest.approx(2 * MESSAGE_S)
    assert len(made.link.requests) - sent == 2


def test_each_value_of_a_ramp_costs_two_messages(driven):
    made = driven()
    made.open()
    made.exchange(3.0)
    sent = len(made.link.requests)
    for value in (2.0, 1.0, 0.0):
        made.device.make_safe(value)
        assert made.current_a == pytest.approx(value)
        assert not made.link.is_open
    assert len(made.link.requests) - sent == 6


def test_who_never_opened_it_waits_for_nothing(driven):
    """Whether an older command may come is the caller's affair."""
    made = driven()
    before_s = made.time()
    made.device.make_safe(-1.0)
    assert made.current_a == pytest.approx(-1.0)
    assert made.time() - before_s == pytest.approx(2 * MESSAGE_S)


def test_a_silent_device_is_tried_once(driven):
    """Within its time-out, without a word on what the output is at."""
    made = driven()
    made.link.silent_until_s = 1e9
    before_s = made.time()
    with pytest.raises(DeviceError, match=r"no answer .* \(to make safe"):
        made.device.make_safe(0.0)
    assert made.time() - before_s <= TIMEOUT_S + MESSAGE_S
    assert not made.link.is_open
    made.link.silent_until_s = 0.0
    made.device.make_safe(0.0)


def test_a_connection_that_is_refused_ends_the_attempt(driven):
    made, tried = driven(), []

    def refuse(peer):
        tried.append(peer)
        raise DeviceError("connection refused")

    made.device._safe_write._connect = refuse
    with pytest.raises(DeviceError, match="connection refused"):
        made.device.make_safe(0.0)
    assert len(tried) == 1


@pytest.mark.parametrize("late_s", [0.11, 0.3, 0.8])
def test_a_value_that_is_written_over_is_not_confirmed(driven, late_s):
    """An older command is executed between the write and its confirmation."""
    made = driven()
    made.open()
    made.link.late_s = late_s
    with pytest.raises(DeviceError, match="no answer"):
        made.exchange(4.0)
    put_out = made.device._safe_write._put

    def written_over(session, value):
        put_out(session, value)
        made.time.sleep(late_s)

    made.device._safe_write._put = written_over
    with pytest.raises(DeviceError, match="0 V was written, but 4"):
        made.device.make_safe(0.0)
    made.device.make_safe(0.0)
    assert made.current_a == 0.0


class Rounding(FaultyLink):
    """Drops the low bits of what is written, as a coupler's terminals do."""

    def transact(self, request, missing, usual=0):
        reply = super().transact(request, missing, usual)
        self._wire._devices[1]._outputs["AO0"].words[0] &= ~0b111
        return reply


@pytest.mark.parametrize(
    ("profile", "link"), [("wago_750", Rounding), ("generic_float32", FaultyLink)]
)
def test_readback_may_be_rounded(driven, profile, link):
    """That is no other value."""
    made = driven(profile, link=link)
    made.open()
    made.device.make_safe(0.3337)
    assert made.current_a == pytest.approx(0.3337, abs=1e-3)


def test_a_step_of_the_output_is_no_other_value(driven):
    """Which of two neighbours a device rounds to is its own affair; floats round to a millionth."""
    for profile in ("wago_750", "generic_float32"):
        safe_write = driven(profile).device._safe_write
        output = safe_write._setup.output
        step = output.step or 1e-6 * (output.max - output.min)
        assert step > 0.0
        safe_write._check(step, 0.0)
        with pytest.raises(DeviceError):
            safe_write._check(1.01 * step, 0.0)


def test_no_name_is_looked_up_for_it():
    """The address is that which was reached at opening."""
    with emulated(EmulatorOptions("generic_float32")) as served:
        hosts = []

        def connect(peer):
            hosts.append(peer.host)
            return peer.session()

        options = ModbusOptions.model_validate(
            {**served.options, "host": "localhost", "timeout_s": 20.0}
        )
        device = ModbusDac(options, connect)
        device.open(RATE_HZ, 1)
        device.make_safe(0.0)
        assert hosts == ["localhost", "127.0.0.1"]


@pytest.mark.parametrize("silence_s", [0.6, 3.0])
def test_device_that_was_silent_is_made_safe_when_it_is_back(driven, silence_s):
    """By the caller's attempts, each on a new connection."""
    made = driven()
    made.open()
    made.exchange(3.0)
    back_s = made.time() + silence_s
    made.link.silent_until_s = back_s
    with pytest.raises(DeviceError):
        made.exchange(4.0)
    made_safe(made.device, 0.0)
    first = made.writes()[-1]
    assert first["current_a"] == 0.0
    assert 0.0 <= first["monotonic_ns"] * 1e-9 - back_s <= TIMEOUT_S + 2 * MESSAGE_S
