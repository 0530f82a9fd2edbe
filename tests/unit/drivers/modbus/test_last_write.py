"""The last write against an emulated device in this process, in a time that tests make pass."""

import itertools

import pytest

from hilctl.base.errors import DeviceError
from hilctl_drivers.emulator.options import EmulatorOptions
from hilctl_drivers.modbus.device import ModbusDac
from hilctl_drivers.modbus.last_write import ANSWER_S, POLL_S, RETRY_S, TRIES_S
from hilctl_drivers.modbus.setup import ModbusOptions
from tests.fakes import FaultyLink, emulated

MESSAGE_S = 0.001
TIMEOUT_S = 0.1
HOLD_S = 2 * ANSWER_S
RATE_HZ = 100.0


@pytest.mark.parametrize("late_s", [0.11, 0.3, 0.8])
@pytest.mark.parametrize("readable", [True, False])
def test_command_that_is_carried_out_late_is_written_over(driven, write_only, late_s, readable):
    """It timed out on the connection before, and comes after the safe value."""
    made = driven("generic_float32" if readable else write_only)
    made.open()
    made.exchange(1.0)
    made.link.late_s = late_s
    with pytest.raises(DeviceError, match="no answer"):
        made.exchange(4.0)
    made.device.make_safe(0.0)
    put_out = [each["current_a"] for each in made.writes()]
    assert put_out[put_out.index(pytest.approx(4.0)) - 1] == 0.0  # the first try was at once
    made.time.sleep(60.0)
    assert made.current_a == 0.0


def test_safe_value_is_there_at_once(driven):
    """The first message is the write; what takes longer comes after it."""
    made = driven()
    made.open()
    made.exchange(3.0)
    made.link.late_s = 0.5
    with pytest.raises(DeviceError):
        made.exchange(4.0)
    before_s = made.time()
    made.device.make_safe(-1.0)
    first = next(each for each in made.writes() if each["current_a"] == pytest.approx(-1.0))
    assert first["monotonic_ns"] * 1e-9 - before_s == pytest.approx(MESSAGE_S)


def test_healthy_device_is_not_waited_for(driven):
    """With each command answered, one message writes and one reads back."""
    made = driven()
    made.open()
    made.exchange(3.0)
    before_s, sent = made.time(), len(made.link.requests)
    made.device.make_safe(-1.0)
    assert made.time() - before_s == pytest.approx(2 * MESSAGE_S)
    assert len(made.link.requests) - sent == 2
    assert made.current_a == pytest.approx(-1.0)


def test_who_never_opened_it_waits_for_others(driven):
    """A process that takes over does not know what the one before has sent."""
    made = driven()
    made.link.open()
    made.device.make_safe(-1.0)
    assert made.current_a == pytest.approx(-1.0)
    assert HOLD_S <= made.time() - 1.0 <= HOLD_S + 0.01
    assert len(made.link.requests) <= HOLD_S / POLL_S + 3  # others use the device meanwhile


@pytest.mark.parametrize("silence_s", [0.6, 3.0])
def test_device_that_was_silent_is_made_safe_when_it_is_back(driven, silence_s):
    """It is tried again on new connections, and held from when it answers."""
    made = driven()
    made.open()
    made.exchange(3.0)
    back_s = made.time() + silence_s
    made.link.silent_until_s = back_s
    with pytest.raises(DeviceError):
        made.exchange(4.0)
    made.device.make_safe(0.0)
    first = made.writes()[-1]
    assert first["current_a"] == 0.0
    assert 0.0 <= first["monotonic_ns"] * 1e-9 - back_s <= TIMEOUT_S + RETRY_S + 2 * MESSAGE_S
    assert made.time() - back_s >= HOLD_S


def test_device_that_stays_silent_is_given_up(driven):
    """In a bounded time, with what is not known said."""
    made = driven()
    made.link.silent_until_s = 1e9
    before_s = made.time()
    with pytest.raises(DeviceError, match=r"no answer .* puts out is not known \(to make safe"):
        made.device.make_safe(0.0)
    assert TRIES_S <= made.time() - before_s <= TRIES_S + HOLD_S + 2 * TIMEOUT_S
    assert not made.link.is_open


def test_a_device_that_refuses_at_once_is_not_flooded(driven):
    """It is asked twenty times a second."""
    made, tried_s = driven(), []

    def refuse(peer):
        assert len(tried_s) < 1000
        tried_s.append(made.time())
        raise DeviceError("connection refused")

    made.device._last_write._connect = refuse
    with pytest.raises(DeviceError, match=r"refused; what it puts out is not known"):
        made.device.make_safe(0.0)
    assert {round(b - a, 6) for a, b in itertools.pairwise(tried_s)} == {RETRY_S}


def test_slow_time_out_does_not_keep_a_silent_peer(driven):
    """However long an exchange may take, a new connection is made in time."""
    made = driven(timeout_s=3.0)
    made.device.make_safe(0.0)
    assert [peer.timeout_s for peer in made.peers] == [ANSWER_S]


class Rewriting(FaultyLink):
    """Another host that writes the output now and then, until a time."""

    until_s = 0.0
    every_s = 0.0
    written_s = 0.0

    def transact(self, request, missing, usual=0):
        reply = super().transact(request, missing, usual)
        if self._time() < self.until_s and self._time() - self.written_s >= self.every_s:
            self.written_s = self._time()
            self._wire._devices[1].write("holding", 0, [0x40A0, 0])  # 5 V
        return reply


@pytest.mark.slow
@pytest.mark.parametrize(("for_s", "every_s"), [(1.0, 0.0), (1e6, 0.0), (1e6, 0.9 * HOLD_S)])
def test_safe_means_that_it_holds(driven, for_s, every_s):
    """A value that another host keeps writing over is not said to be safe."""
    made = driven(link=Rewriting)
    made.open()
    made.exchange(0.0)
    made.link.late_s = 1e9
    with pytest.raises(DeviceError):
        made.exchange(0.0)
    made.link.until_s, made.link.every_s = made.time() + for_s, every_s
    made.link.written_s = made.time()
    if for_s == 1.0:
        made.device.make_safe(0.0)
        assert made.current_a == 0.0
        return
    with pytest.raises(DeviceError, match="not seen to stay; what it puts out is not known"):
        made.device.make_safe(0.0)
    assert made.time() < 30.0


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
    """That is no other value, and nothing to write again."""
    made = driven(profile, link=link)
    made.open()
    before = len(made.writes())
    made.device.make_safe(0.3337)
    assert len(made.writes()) == before + 1
    assert made.current_a == pytest.approx(0.3337, abs=1e-3)


def test_a_step_of_the_output_is_no_other_value(driven):
    """Which of two neighbours a device rounds to is its own affair; floats round to a millionth."""
    for profile in ("wago_750", "generic_float32"):
        last_write = driven(profile).device._last_write
        output = last_write._setup.output
        step = output.step or 1e-6 * (output.max - output.min)
        assert step > 0.0
        assert last_write._agrees(step, 0.0)
        assert not last_write._agrees(1.01 * step, 0.0)


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
