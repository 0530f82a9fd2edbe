"""The host watchdog of a Modbus device: what feeds it, and what opens a device that has tripped."""

import socket

import pytest

from hilctl.base.errors import DeviceError
from hilctl_drivers.dac import ModbusDac, ModbusOptions
from hilctl_drivers.emulator.options import EmulatorOptions
from tests.fakes import emulated, made_safe
from tests.unit.drivers.modbus.conftest import MESSAGE_S, RATE_HZ, exchange
from tests.unit.drivers.modbus.conftest import TIMEOUT_S as ANSWER_S

TIMEOUT_S = 0.5
TRIPPED = {"timeout_s": TIMEOUT_S}
SOFT = """\
vendor: nobody
model: a module that obeys while its watchdog is tripped, and acts once it is cleared
source: [this test]
verified: "yes"
link: {kind: tcp}
address_base: 0
exchange: 23
turnaround_s: 0.0
max_rate_hz: 1000.0
outputs:
  OUT: {address: 0, type: float32, unit: V, min: -10.0, max: 10.0}
inputs:
  IN: {address: 2, type: float32, unit: V, min: -10.0, max: 10.0}
watchdog:
  unit_s: 0.1
  min_s: 0.1
  max_s: 10.0
  kick: any
  on_trip: ON_TRIP
  refuses_while_tripped: REFUSES
  tripped: {address: 28, type: uint16, mask: 1}
  arm:
    - {kind: write, address: 22, type: uint16, value: timeout}
    - {kind: write, address: 24, type: uint16, value: 1}
  clear:
    - {kind: write, address: 26, type: uint16, value: 1}
SAFE"""
SAFE = """\
  safe:
    OUT:
      - {kind: write, address: 20, type: float32, value: safe}
"""


@pytest.fixture
def soft(tmp_path):
    """Return a function that writes a profile of a module and returns its path."""

    def of(*, on_trip="safe", refuses="false", safe=SAFE):
        path = tmp_path / "soft.yaml"
        text = SOFT.replace("ON_TRIP", on_trip).replace("REFUSES", refuses).replace("SAFE", safe)
        path.write_text(text, encoding="utf-8")
        return str(path)

    return of


def trip(made, current_a):
    """Let a device's watchdog trip in the middle of a run."""
    made.open()
    made.exchange(current_a)
    made.time.sleep(TIMEOUT_S + 0.1)
    made.emulated.device.tick(made.time.now_ns)
    assert made.emulated.device.tripped
    made.device.close()


class TestWatchdog:
    def test_writes_feed_it(self, serve):
        served = serve("icp_m7024", "icp_m7017")
        device = served.running(5.0, watchdog={"timeout_s": 1.0})
        for _ in range(6):
            served.clock.pass_s(0.5)
            exchange(device, 2.0)
        assert not served.emulator.device.tripped
        served.clock.pass_s(1.5)
        with pytest.raises(DeviceError, match="exception 4"):
            exchange(device, 2.0)
        assert served.emulator.device.tripped

    @pytest.mark.parametrize("profile", ["wago_750", "beckhoff_bk9000"])
    def test_it_does_not_count_while_a_run_waits_to_start(self, driven, profile):
        made = driven(profile, watchdog=TRIPPED)
        made.device.open(100.0, 1)
        made.time.sleep(60.0)
        made.device.arm()
        made.exchange(1.0)
        assert not made.emulated.device.tripped
        made.time.sleep(TIMEOUT_S + 0.1)
        with pytest.raises(DeviceError, match="exception 4"):
            made.exchange(1.0)

    def test_a_device_that_cannot_be_armed_is_let_go(self, driven):
        made = driven("wago_750", watchdog=TRIPPED)
        with pytest.raises(DeviceError, match=r"not open .*watchdog"):
            made.device.arm()
        made.device.open(100.0, 1)
        made.link.silent_until_s = 1e9
        with pytest.raises(DeviceError, match=r"no answer .*watchdog"):
            made.device.arm()
        assert not made.link.is_open
        with pytest.raises(DeviceError, match="not open"):
            made.exchange(1.0)


class TestTrip:
    @pytest.mark.parametrize(
        "profile", ["wago_750", "beckhoff_bk9000", "soft", "soft refuses", "soft zero"]
    )
    def test_opening_does_not_move_the_output(self, driven, soft, profile):
        """The register still holds the command at which the host died; it must not take effect."""
        words = profile.split()
        if words[0] == "soft":
            refuses = "true" if "refuses" in words else "false"
            zero = {"on_trip": "zero", "safe": ""} if "zero" in words else {}
            profile = soft(refuses=refuses, **zero)
        made = driven(profile, watchdog=TRIPPED)
        trip(made, 3.21)
        before = len(made.writes())
        made.open()
        assert made.device.output() == pytest.approx(0.0, abs=1e-3)
        made.exchange(0.01)
        since = [each["current_a"] for each in made.writes()[before:]]
        assert max(map(abs, since)) == pytest.approx(0.01, abs=1e-3)
        assert not made.emulated.device.tripped

    def test_the_output_stays_where_the_earlier_run_wanted_it(self, driven, soft):
        made = driven(soft(), watchdog={**TRIPPED, "safe_command": 1.0})
        trip(made, 3.0)
        before = len(made.writes())
        device = made.another(watchdog=TRIPPED)
        device.open(100.0, 1)
        assert device.output() == pytest.approx(1.0)
        since = [each["current_a"] for each in made.writes()[before:]]
        assert since == pytest.approx(len(since) * [1.0])

    def test_what_was_held_is_held_on(self, driven, soft):
        made = driven(soft(on_trip="hold", safe=""))
        has = made.emulated.device
        made.open()
        made.exchange(2.0)
        has._watchdog.tripped = True
        made.open()
        assert made.device.output() == pytest.approx(2.0)
        assert not has.tripped

    def test_unknown_output_is_refused(self, driven, soft):
        """With no safe value in a register or in the experiment, nobody knows where it is."""
        made = driven(soft(on_trip="stored", safe=""), watchdog=TRIPPED)
        trip(made, 3.0)
        device = made.another(watchdog="none")
        before = made.writes()
        with pytest.raises(DeviceError, match="hilctl safe"):
            device.open(100.0, 1)
        assert made.writes() == before
        device.make_safe(0.0)
        assert not made.emulated.device.tripped
        assert made.current_a == 0.0

    @pytest.mark.parametrize("refuses", ["true", "false"])
    def test_last_write_comes_before_and_after_the_trip_is_cleared(self, driven, soft, refuses):
        made = driven(soft(refuses=refuses), watchdog=TRIPPED)
        trip(made, 3.0)
        before = len(made.writes())
        made.device.make_safe(-1.0)
        since = [each["current_a"] for each in made.writes()[before:]]
        assert since == pytest.approx(len(since) * [-1.0])
        assert made.current_a == pytest.approx(-1.0)
        assert not made.emulated.device.tripped


def test_safe_value_is_sent_first(driven):
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


@pytest.mark.parametrize("was_open", [True, False])
def test_each_safe_value_costs_two_messages(driven, was_open):
    made = driven()
    if was_open:
        made.open()
        made.exchange(3.0)
    before_s, sent = made.time(), len(made.link.requests)
    for value in (2.0, 1.0, 0.0):
        made.device.make_safe(value)
        assert made.current_a == pytest.approx(value)
        assert not made.link.is_open
    assert made.time() - before_s == pytest.approx(6 * MESSAGE_S)
    assert len(made.link.requests) - sent == 6


def test_a_silent_device_is_tried_once(driven):
    made = driven()
    made.link.silent_until_s = 1e9
    before_s = made.time()
    with pytest.raises(DeviceError, match=r"no answer .*safe"):
        made.device.make_safe(0.0)
    assert made.time() - before_s <= ANSWER_S + MESSAGE_S
    assert not made.link.is_open
    made.link.silent_until_s = 0.0
    made.device.make_safe(0.0)


@pytest.mark.parametrize("late_s", [0.11, 0.3, 0.8])
def test_a_value_that_is_written_over_is_not_confirmed(driven, late_s):
    made = driven()
    made.open()
    made.link.late_s = late_s
    with pytest.raises(DeviceError, match="no answer"):
        made.exchange(4.0)
    wire = made.device.wire
    write = wire._write

    def written_over(data):
        write(data)
        made.time.sleep(late_s)

    wire._write = written_over
    with pytest.raises(DeviceError, match=r"0 V .*but 4"):
        made.device.make_safe(0.0)
    made.device.make_safe(0.0)
    assert made.current_a == 0.0


def test_a_step_of_the_output_is_no_other_value(driven):
    """Which of two neighbours a device rounds to is its own affair; floats round to a millionth."""
    for profile in ("adam_6024", "generic_float32"):
        wire = driven(profile).device.wire
        output = wire.setup.output
        step = output.step or 1e-6 * (output.max - output.min)
        assert step > 0.0
        wire._write = lambda data: None
        wire.read = lambda found=step: found
        wire.confirm(0.0)
        with pytest.raises(DeviceError):
            wire.confirm(-0.01 * step)


def test_no_name_is_looked_up_for_it(monkeypatch):
    with emulated(EmulatorOptions("generic_float32")) as served:
        hosts, connect = [], socket.create_connection

        def connected(address, timeout_s):
            hosts.append(address[0])
            return connect(address, timeout_s)

        monkeypatch.setattr(socket, "create_connection", connected)
        options = ModbusOptions.model_validate(
            {**served.options, "host": "localhost", "timeout_s": 20.0}
        )
        device = ModbusDac(options)
        device.open(RATE_HZ, 1)
        device.make_safe(0.0)
        assert hosts == ["localhost", "127.0.0.1"]


@pytest.mark.parametrize("silence_s", [0.6, 3.0])
def test_device_that_was_silent_is_made_safe_when_it_is_back(driven, silence_s):
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
    assert 0.0 <= first["monotonic_ns"] * 1e-9 - back_s <= ANSWER_S + 2 * MESSAGE_S
