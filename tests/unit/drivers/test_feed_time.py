"""What feeding a strict watchdog costs, and that the highest rate leaves room for it."""

import pytest

from hilctl_drivers.feed_time import feed_time, with_feeding
from hilctl_drivers.modbus.options import ModbusOptions
from hilctl_drivers.modbus.pdu import coil_pdu, read_pdu, reply_size, rtu_adu, write_single_pdu
from hilctl_drivers.modbus.setup import ModbusSetup
from hilctl_drivers.profile import load_profile, parse_profile
from hilctl_drivers.serial.options import SerialOptions
from hilctl_drivers.serial.setup import SerialSetup
from hilctl_drivers.wire_time import exchange_time

CHAR_S = 10 / 9600
GAP_S = 3.5 * CHAR_S
PROFILE = """\
vendor: Acme
model: DAQ-1
source: [manual]
verified: "yes"
link: {kind: rtu, baud: 9600}
address_base: 0
exchange: none
turnaround_s: 0.002
max_rate_hz: 10000.0
outputs:
  AO: {address: 0, type: float32, unit: V, min: -10.0, max: 10.0}
inputs:
  AI: {address: 4, type: float32, unit: V, min: -10.0, max: 10.0}
watchdog:
  unit_s: 0.1
  min_s: 0.1
  max_s: 25.5
  kick: strict
  on_trip: zero
  refuses_while_tripped: false
  arm:
    - {kind: write, address: 100, type: uint16, value: timeout}
  feed:
    - FEED
"""
FEED = "{kind: write, address: 101, type: uint16, value: 1}"
READER = """\
vendor: Acme
model: ADC-1
source: [manual]
verified: "yes"
link: {kind: ascii, baud: 9600, terminator: "\\r", reply_terminator: "\\r"}
address: 2
exchange: none
turnaround_s: 0.0
max_rate_hz: 100.0
outputs:
  NONE:
    {write: "#{address:02X}{value:+07.3f}", reply: none, unit: V, min: 0.0, max: 1.0}
inputs:
  AI:
    {ask: "#{address:02X}0", pattern: ">([+-][0-9.]+)", example: ">+05.000", unit: V, min: -10.0,
     max: 10.0}
watchdog: none
"""


def acme(feed=FEED, link="{kind: rtu, baud: 9600}"):
    """Return a Modbus device that is fed by these steps."""
    text = PROFILE.replace("FEED", feed).replace("{kind: rtu, baud: 9600}", link)
    return parse_profile(text, "acme.yaml")


def requests_s(*pdus):
    """Return what requests and replies take at 9600 baud, gaps and turnaround included."""
    characters = sum(len(rtu_adu(1, pdu)) + reply_size(pdu) + 3 for pdu in pdus)
    return characters * CHAR_S + len(pdus) * (2 * GAP_S + 0.002)


READ, WRITE = read_pdu(3, 101, 1), write_single_pdu(101, bytes(2))


@pytest.mark.parametrize(
    ("feed", "seconds"),
    [
        (FEED, requests_s(WRITE)),
        (FEED.replace("}", ", verify: true}"), requests_s(WRITE, READ)),
        (FEED.replace("write", "ensure"), requests_s(READ, WRITE, READ)),
        (FEED.replace("write", "expect"), requests_s(READ)),
        ("{kind: wait, seconds: 0.25}", 0.25),
        (f"{FEED}\n    - {{kind: wait, seconds: 0.25}}", requests_s(WRITE) + 0.25),
        (
            "{kind: write, area: coil, address: 7, type: bit, value: 1}",
            requests_s(coil_pdu(7, True)),
        ),
    ],
)
def test_each_kind_of_step_counts_with_all_that_it_may_send(feed, seconds):
    """A step that writes only what differs counts as if it did."""
    assert feed_time(acme(feed)).total_s == pytest.approx(seconds)


def test_over_tcp_the_turnaround_counts():
    """There are no characters to wait for, but the device takes its time."""
    assert feed_time(acme(link="{kind: tcp}")).total_s == pytest.approx(0.002)


@pytest.mark.parametrize("name", ["labjack_t7", "wago_750", "adam_6024", "cobs_board", "kepco_bop"])
def test_watchdogs_that_exchanges_feed_cost_nothing(name):
    """Nor do devices without one."""
    profile = load_profile(name)
    assert feed_time(profile) is None
    exchange = exchange_time(load_profile("labjack_t7"), "DAC0", "AIN0")
    assert with_feeding(exchange, profile) is exchange


def test_an_unanswered_line_costs_its_characters():
    """DCON's ~** is heard by all modules on the line and answered by none."""
    time = feed_time(load_profile("icp_m7024_dcon"))
    assert time.total_s == time.request_s == pytest.approx(len("~**\r") * CHAR_S)


def test_a_tick_that_feeds_must_fit():
    """The rate that is left is that of an exchange and a feeding, one after the other."""
    profile = acme()
    exchange = exchange_time(profile, "AO", "AI")
    both = with_feeding(exchange, profile)
    assert both.total_s == pytest.approx(exchange.total_s + requests_s(WRITE))
    assert (both.gaps, both.samples) == (6, 1)
    assert str(both).startswith(
        "FC03+FC16 at 9600 8N1, then FC06 at 9600 8N1 to feed the watchdog: request "
    )


def modbus_rate(path, watchdog):
    """Return the highest rate and its reason that modbus_dac gives for a profile."""
    options = {
        "profile": str(path),
        "serial_port": "/dev/ttyUSB0",
        "output": "AO",
        "input": "AI",
        "amplifier": {"gain_a_per_v": 1.0},
        "sensor": {"um_per_v": 10.0},
        "timeout_s": 1.0,
        "watchdog": watchdog,
    }
    info = ModbusSetup.of(ModbusOptions.model_validate(options)).info()
    return info.max_rate_hz, info.rate_note


def test_modbus_dac_leaves_room_for_feeding(tmp_path):
    """Only where the experiment uses the watchdog."""
    path = tmp_path / "acme.yaml"
    path.write_text(PROFILE.replace("FEED", FEED))
    exchange = exchange_time(acme(), "AO", "AI")
    assert modbus_rate(path, "none")[0] == pytest.approx(exchange.highest_rate_hz)
    rate_hz, note = modbus_rate(path, {"timeout_s": 1.0})
    assert rate_hz == pytest.approx(1.0 / (exchange.total_s + requests_s(WRITE)))
    assert "to feed the watchdog" in note


def serial_rate(path, watchdog):
    """Return the highest rate and its reason that serial_dac gives for an ICP M-7024."""
    options = {
        "profile": "icp_m7024_dcon",
        "serial_port": "/dev/ttyUSB0",
        "reader": str(path),
        "output": "AO0",
        "input": "AI",
        "amplifier": {"gain_a_per_v": 1.0},
        "sensor": {"um_per_v": 10.0},
        "watchdog": watchdog,
    }
    return SerialSetup.of(SerialOptions.model_validate(options)).rate(1)


def test_serial_dac_leaves_room_for_feeding(tmp_path):
    """Four characters more in the sample period, where the experiment uses the watchdog."""
    path = tmp_path / "reader.yaml"
    path.write_text(READER)
    bare_hz, bare_note = serial_rate(path, "none")
    rate_hz, note = serial_rate(path, {"timeout_s": 1.0})
    assert 1.0 / rate_hz - 1.0 / bare_hz == pytest.approx(4 * CHAR_S)
    assert "feeding the watchdog 4.17 ms" in note
    assert "feeding" not in bare_note
