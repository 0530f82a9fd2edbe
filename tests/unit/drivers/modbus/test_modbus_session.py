"""A session with a reader on another module: self-test, steps, faults, and letting go."""

import itertools
import struct

import pytest

from hilctl.base.errors import DeviceError
from hilctl_drivers.dac import ModbusDac, ModbusOptions
from hilctl_drivers.emulator.options import parse_fault
from hilctl_drivers.modbus.modbus_session import ModbusSession
from hilctl_drivers.modbus.pdu import (
    coil_pdu,
    feedback_pdu,
    read_frame,
    read_pdu,
    reply_size,
    rtu_adu,
    tcp_adu,
    write_frame,
    write_pdu,
    write_read_pdu,
    write_single_pdu,
)
from hilctl_drivers.modbus.register_map import EnsureStep, ExpectStep, WriteStep
from hilctl_drivers.modbus.tick_plan import TickPlan
from hilctl_drivers.profile import load_profile, parse_profile, with_link
from hilctl_drivers.profile_base import WaitStep
from hilctl_drivers.transport import links
from tests.fakes import AnsweringLink
from tests.unit.drivers.modbus.conftest import exchange


class Line:
    """A device over Modbus TCP with coils and registers at any address."""

    def __init__(self):
        self.asked, self.coils, self.registers = [], {}, {}

    def transact(self, request, missing, usual):
        head, pdu = request[:4], request[7:]
        function, address, value = struct.unpack_from(">BHH", pdu)
        self.asked.append(function)
        reply = pdu[:5]
        if function == 1:
            reply = bytes([1, 1, self.coils[address]])
        elif function == 3:
            words = [self.registers[address + i] for i in range(value)]
            reply = struct.pack(f">BB{value}H", 3, 2 * value, *words)
        elif function == 5:
            self.coils[address] = value >> 8 & 1
        elif function == 6:
            self.registers[address] = value
        else:
            for i, (word,) in enumerate(struct.iter_unpack(">H", pdu[6:])):
                self.registers[address + i] = word
        return head + struct.pack(">HB", 1 + len(reply), request[6]) + reply


class TestSteps:
    @pytest.fixture
    def session(self, reader):
        self.line, self.slept_s = Line(), []
        profile = load_profile(reader)
        return ModbusSession(profile, self.line, 9, self.slept_s.append, framing="tcp")

    def test_each_kind_of_register_has_its_function(self, session):
        one = {"kind": "write", "address": 7, "type": "uint16", "value": 3.0}
        two = {"kind": "write", "address": 8, "type": "float32", "value": 1.5}
        session.run([WriteStep(**one), WriteStep(**two)])
        assert self.line.asked == [6, 16]
        assert self.line.registers == {7: 3, 8: 0x3FC0, 9: 0}

    @pytest.mark.parametrize("value", [0.0, 1.0])
    def test_bits_are_coils(self, session, value):
        bit = {"area": "coil", "address": 3, "type": "bit", "value": value}
        self.line.coils[3] = int(not value)
        ensure = EnsureStep(kind="ensure", **bit)
        assert session.would_change([ensure])
        session.run([ensure, WriteStep(kind="write", verify=True, **bit)])
        assert self.line.asked == [1, 1, 5, 1, 5, 1]
        assert self.line.coils == {3: value}
        assert not session.would_change([ensure])
        self.line.coils[3] = int(not value)
        said = f"must hold {value}, got {1 - value:g}, at step expect coil 3"
        with pytest.raises(DeviceError, match=said):
            session.run([ExpectStep(kind="expect", **bit)])

    def test_a_wait_is_waited(self, session):
        write = WriteStep(kind="write", address=7, type="uint16", value=3.0)
        session.run([WaitStep(kind="wait", seconds=0.25), write])
        assert self.slept_s == [0.25]
        assert self.line.asked == [6]


class TestReader:
    def test_self_test_comes_before_anything_moves(self, serve):
        served = serve("adam_4024", "adam_4117")
        words, _ = served.emulator.reader.memory._readable["holding", 210]
        words.data = b"\x40\x18"
        said = r"at /dev/pts/\d+: reader adam_4117, unit 2 at /dev/pts/\d+: self-test .* \(to open"
        with pytest.raises(DeviceError, match=said):
            served.device().open(5.0, 1)
        assert served.events() == []

    def test_init_and_close_steps_are_carried_out(self, serve, reader):
        served = serve("adam_4024", reader)
        state, _ = served.emulator.reader.memory._readable["holding", 7]
        device = served.running(5.0, baud=115200)
        assert state.data == b"\0\1"
        exchange(device, 1.0)
        device.close()
        assert state.data == b"\0\2"

    def test_expectations_are_checked(self, serve):
        served = serve("waveshare_ao_8ch", "waveshare_ai_8ch")
        words, _ = served.emulator.reader.memory._readable["holding", 0x1000]
        words.data = b"\0\3"
        with pytest.raises(DeviceError, match=r"reader waveshare_ai_8ch.* 0 to 20 mA\)"):
            served.device().open(5.0, 1)

    @pytest.mark.parametrize(
        ("fault", "said"),
        [({"mute": frozenset({4})}, "no answer"), ({"lacking": frozenset({4})}, "exception 1")],
    )
    def test_input_that_can_not_be_read_moves_nothing(self, serve, fault, said):
        served = serve("icp_m7024", "icp_m7017", **fault)
        with pytest.raises(DeviceError, match=rf": reader icp_m7017, .*{said}.* \(to open\)"):
            served.device(timeout_s=0.5).open(5.0, 1)
        assert served.events() == []

    @pytest.mark.parametrize(
        ("fault", "said", "timeout_s"),
        [("silence@1s", "no answer", 0.5), ("exception@1s", "exception 4", 20.0)],
    )
    def test_errors_name_the_reader(self, serve, fault, said, timeout_s):
        served = serve("icp_m7024", "icp_m7017", faults=(parse_fault(fault),))
        device = served.running(5.0, timeout_s=timeout_s)
        served.clock.pass_s(2.0)
        named = rf"modbus_dac icp_m7024 at .*: reader icp_m7017, unit 2 at .*: .*{said}.* \(to wri"
        with pytest.raises(DeviceError, match=named):
            exchange(device, 1.0)
        assert [each["current_a"] for each in served.events()] == pytest.approx([0.0], abs=1e-3)
        with pytest.raises(DeviceError, match="not open"):
            exchange(device, 1.0)
        device.make_safe(0.0)
        assert served.events()[-1]["current_a"] == pytest.approx(0.0, abs=1e-3)

    def test_errors_of_the_one_that_drives_are_not_the_readers(self, serve):
        served = serve("icp_m7024", "icp_m7017", lacking=frozenset({6}))
        with pytest.raises(DeviceError, match=r"function 6 .*exception 1") as refused:
            served.device().open(5.0, 1)
        assert "reader" not in str(refused.value)

    def test_both_lines_are_let_go_of(self, serve):
        faults = (parse_fault("silence@1s"),)
        served = serve("icp_m7024", "icp_m7017", reader_line="own", faults=faults)
        device, other = served.running(5.0, timeout_s=0.5), served.device()
        with pytest.raises(DeviceError, match="cannot be opened"):
            other.open(5.0, 1)
        served.clock.pass_s(2.0)
        with pytest.raises(DeviceError, match="reader icp_m7017"):
            exchange(device, 1.0)
        device.make_safe(0.0)
        other.open(5.0, 1)
        other.close()

    def test_the_safe_value_does_not_wait_for_the_reader(self, serve):
        served = serve("adam_6224", "agilent_34970a")
        device = served.running(5.0)
        exchange(device, 1.0)
        reader, released = device.reader, []
        served.emulator.wires[1].devices = []
        reader.link.timeout_s = 0.2
        reader.release = lambda: released.append(served.events()[-1]["current_a"])
        with pytest.raises(DeviceError, match="reader agilent_34970a"):
            exchange(device, 1.0)
        assert released == []
        device.make_safe(-1.0)
        assert released == [pytest.approx(-1.0, abs=1e-3)]

    def test_no_reader_there_moves_nothing(self, serve):
        served = serve("adam_6224", "adam_6217")
        said = r"reader adam_6217, unit 1 at 127\.0\.0\.1:1: cannot connect: .* \(to open\)"
        with pytest.raises(DeviceError, match=said):
            served.device(reader={**served.emulator.options["reader"], "tcp_port": 1}).open(5.0, 1)
        assert served.events() == []


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
  SMALL: {address: 8, type: int16, function: 6, scale: 0.001, unit: V, min: -10.0, max: 10.0}
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
LINES = [(9600, "N"), (19200, "E"), (115200, "N"), (921600, "N")]
TABLE_MS = {
    "FC16": (21.9, 12.0, 1.82, 0.23),
    "FC06": (16.7, 9.2, 1.39, 0.17),
    "FC03": (17.7, 9.7, 1.48, 0.18),
    "FC23": (27.1, 14.9, 2.26, 0.28),
}
TABLE_HZ = {"gaps": (29.0, 53.0, 174.0, 264.0), "none": (37.0, 67.0, 443.0, 3545.0)}


def acme(feed=FEED, link="{kind: rtu, baud: 9600}"):
    """Return a Modbus device that is fed by these steps."""
    text = PROFILE.replace("FEED", feed).replace("{kind: rtu, baud: 9600}", link)
    return parse_profile(text, "acme.yaml")


def rtu(baud=115200, parity="N", **link):
    """Return a Modbus RTU device on a line, which exchanges in one transaction in no time."""
    fast = acme().model_copy(update={"exchange": 23, "turnaround_s": 0.0})
    return with_link(fast, baud=baud, parity=parity, **link)


def exchange_time(profile, output, sensor, *, one_transaction=True):
    """Return the time to write an output and to read an input, by name; None to write only."""
    inputs = [] if sensor is None else [profile.inputs[sensor]]
    return TickPlan(profile, [profile.outputs[output]], inputs, combine=one_transaction).time


def wire_s(time):
    return time.request_s + time.reply_s


class TestRtu:
    """Modbus RTU, against a table worked out by hand: two float32 registers each way."""

    @pytest.mark.parametrize("column", range(4))
    def test_characters(self, column):
        profile = rtu(*LINES[column])
        both = exchange_time(profile, "AO", "AI", one_transaction=False)
        write = exchange_time(profile, "AO", None)
        small = exchange_time(profile, "SMALL", None)
        found = {
            "FC16": wire_s(write),
            "FC06": wire_s(small),
            "FC03": wire_s(both) - wire_s(write),
            "FC23": wire_s(exchange_time(profile, "AO", "AI")),
        }
        for function, row in TABLE_MS.items():
            assert found[function] * 1e3 == pytest.approx(row[column], rel=0.03), function

    @pytest.mark.parametrize("column", range(4))
    def test_rate(self, column):
        baud, parity = LINES[column]
        gaps = exchange_time(rtu(baud, parity), "AO", "AI")
        none = exchange_time(rtu(baud, parity, gap_s=0.0), "AO", "AI")
        assert gaps.highest_rate_hz == pytest.approx(TABLE_HZ["gaps"][column], rel=0.03)
        assert none.highest_rate_hz == pytest.approx(TABLE_HZ["none"][column], rel=0.03)


@pytest.mark.parametrize(("output", "one", "rate_hz", "text"), [
    ("DAC0", True, 1000.0, "FC76 over TCP: turnaround 1.00 ms"),
    ("DAC0", False, 500.0, "FC03+FC16 over TCP: turnaround 2.00 ms"),
    ("TDAC0", False, 1000 / 3, "turnaround 2.00 ms, settling 1.00 ms"),
])  # fmt: skip
def test_time_over_tcp_is_the_device_s_own(output, one, rate_hz, text):
    """A LabJack T7 takes 1 ms a round trip, and an LJTick-DAC another one to settle."""
    time = exchange_time(load_profile("labjack_t7"), output, "AIN0", one_transaction=one)
    assert time.highest_rate_hz == pytest.approx(rate_hz)
    assert str(time).endswith(text)


def requests_s(*pdus):
    """Return what requests and replies take at 9600 baud, gaps and turnaround included."""
    characters = sum(len(rtu_adu(1, pdu)) + reply_size(pdu) + 3 for pdu in pdus)
    return characters * CHAR_S + len(pdus) * (2 * GAP_S + 0.002)


READ, WRITE = read_pdu(3, 101, 1), write_single_pdu(101, bytes(2))


@pytest.mark.parametrize(("feed", "seconds"), [
    (FEED, requests_s(WRITE)),
    (FEED.replace("}", ", verify: true}"), requests_s(WRITE, READ)),
    (FEED.replace("write", "ensure"), requests_s(READ, WRITE, READ)),
    (FEED.replace("write", "expect"), requests_s(READ)),
    ("{kind: wait, seconds: 0.25}", 0.25),
    (f"{FEED}\n    - {{kind: wait, seconds: 0.25}}", requests_s(WRITE) + 0.25),
    ("{kind: write, area: coil, address: 7, type: bit, value: 1}", requests_s(coil_pdu(7, True))),
])  # fmt: skip
def test_each_kind_of_step_counts_with_all_that_it_may_send(feed, seconds):
    assert ModbusSession.feed_time(acme(feed)).total_s == pytest.approx(seconds)


@pytest.mark.parametrize("name", ["labjack_t7", "wago_750", "adam_6024"])
def test_watchdogs_that_exchanges_feed_cost_nothing(name):
    assert ModbusSession.feed_time(load_profile(name)) is None


def test_register_wire_leaves_room_for_feeding(tmp_path):
    path = tmp_path / "acme.yaml"
    path.write_text(PROFILE.replace("FEED", FEED))
    options = {
        "profile": str(path),
        "serial_port": "/dev/ttyUSB0",
        "output": "AO",
        "input": "AI",
        "amplifier": {"gain_a_per_v": 1.0},
        "sensor": {"um_per_v": 10.0},
        "timeout_s": 1.0,
    }
    exchange_s = exchange_time(acme(), "AO", "AI").total_s
    for watchdog, feed_s in (("none", 0.0), ({"timeout_s": 1.0}, requests_s(WRITE))):
        info = ModbusDac(ModbusOptions.model_validate({**options, "watchdog": watchdog})).info
        assert info.max_rate_hz == pytest.approx(1.0 / (exchange_s + feed_s))
        assert ("feed the watchdog" in info.rate_note) == (watchdog != "none")


@pytest.mark.parametrize(
    ("profile", "reader"),
    [("labjack_t7", None), ("adam_6224", "adam_6217"), ("adam_4024", "adam_4117")],
)
def test_input_and_output_are_read(serve, profile, reader):
    served = serve(profile, reader)
    served.device().make_safe(3.0)
    served.clock.pass_s(0.5)
    before = served.events()
    displacement_um, output, *_ = served.device().look()
    assert output == pytest.approx(3.0, abs=0.02)
    assert 10.0 < displacement_um < 45.0
    assert served.events() == before


def test_an_exception_names_the_key(serve, variant):
    served = serve("generic_float32")
    given = served.device(profile=variant(("address: 2, type", "address: 60000, type")))
    with pytest.raises(DeviceError, match=r"exception 2 .* 60000 \(inputs\.IN "):
        given.look()


def test_a_denormal_read_back_is_named(serve, variant):
    """3 V with its words swapped is 2.3e-41, which the offset of an amplifier would hide."""
    right = "address: 0, type: float32, order: ABCD"
    swapped = variant((right, right.replace("ABCD", "CDAB")))
    served = serve("generic_float32")
    served.device().make_safe(3.0)
    given = served.device(profile=swapped, amplifier={"gain_a_per_v": 1.0, "offset_a": 0.5})
    with pytest.raises(DeviceError, match=r"OUT must be .*order"):
        given.look()


def test_a_command_from_before_a_trip_is_not_taken_for_the_output(serve):
    served = serve("wago_750")
    device = served.running(watchdog={"timeout_s": 0.5})
    exchange(device, 3.0)
    device._release()
    served.clock.pass_s(0.6)
    found = served.device().look()
    assert (found.output, found.tripped) == (None, True)
    assert served.emulator.device.tripped


H = bytes.fromhex
OLD, NEW, REPLY = H("01020304"), H("C61C3C00"), H("40200000")

# Name: request by its data, the data's size, a good reply by the data, what is read.
CASES = {
    "read": (lambda _: read_pdu(4, 0, 2), 0, lambda _: b"\4\4" + REPLY, REPLY),
    "coil": (lambda _: coil_pdu(4, True), 0, lambda _: H("05 0004 FF00"), b""),
    "single": (lambda d: write_single_pdu(7, d), 2, lambda d: H("06 0007") + d, b""),
    "multiple": (lambda d: write_pdu(7, d), 4, lambda _: H("10 0007 0002"), b""),
    "write_read": (
        lambda d: write_read_pdu(0, 2, 9, d),
        4,
        lambda _: H("17 04") + REPLY,
        REPLY,
    ),
    "feedback": (
        lambda d: feedback_pdu(read_frame(0, 2), write_frame(9, d)),
        4,
        lambda _: b"\x4c" + REPLY,
        REPLY,
    ),
}
ALL = pytest.mark.parametrize("case", CASES)
BOTH = pytest.mark.parametrize("wire", ["tcp", "rtu"])


def session_on(link, wire, unit=17):
    return ModbusSession(load_profile("generic_float32"), link, unit, framing=wire)


class Prepared:
    """A prepared request on a link that answers as told, and the case."""

    def __init__(self, case, wire):
        self.build, self.size, self.reply, self.read = CASES[case]
        self.link, self.wire = AnsweringLink(), wire
        self.call = session_on(self.link, wire).prepare(self.build(OLD[: self.size]))

    def wrap(self, request, pdu):
        """Return a reply to a request."""
        if self.wire == "rtu":
            return rtu_adu(17, pdu)
        return bytes(request[:2]) + tcp_adu(0, 17, pdu)[2:]

    def good(self, request):
        return self.wrap(request, self.reply(NEW[: self.size]))

    def answered(self, answer, *data):
        """Return what is read if ``answer(request)`` comes back."""
        self.link.answer = answer
        return self.call(*data or [NEW[: self.size]])


@ALL
@BOTH
def test_requests_are_those_of_the_plain_functions(case, wire):
    made = Prepared(case, wire)
    for number, data in enumerate((OLD, NEW, OLD), start=1):
        sent = data[: made.size]
        made.answered(lambda request, sent=sent: made.wrap(request, made.reply(sent)), sent)
        pdu = made.build(sent)
        plain = tcp_adu(number, 17, pdu) if wire == "tcp" else rtu_adu(17, pdu)
        assert made.link.request == plain
    request = made.link.request
    made.call()
    assert made.link.request[2:-2] == request[2:-2]


@ALL
@BOTH
def test_good_replies_are_read(case, wire):
    made = Prepared(case, wire)
    for buffer in (bytes, bytearray):
        found = made.answered(lambda request, buffer=buffer: buffer(made.good(request)))
        assert (found, type(found)) == (made.read, bytes)
        assert made.link.usual == len(made.good(made.link.request))


@ALL
@BOTH
def test_how_much_to_wait_for(case, wire):
    made = Prepared(case, wire)

    def refusal(request):
        return made.wrap(request, bytes((made.reply(NEW)[0] | 0x80, 2)))

    for whole in (made.good, refusal):
        size = len(whole(bytes(4)))
        for cut in range(size):
            with pytest.raises(links.IncompleteError):
                made.answered(lambda request, cut=cut, whole=whole: whole(request)[:cut])
            assert 1 <= made.link.missing(whole(made.link.request)[:cut]) <= size - cut
        assert made.link.missing(whole(made.link.request)) == 0
    with pytest.raises(links.RefusedError) as caught:
        made.answered(refusal)
    assert caught.value.code == 2


@ALL
@BOTH
def test_each_flipped_bit_outside_the_data_is_seen(case, wire):
    """RTU sees every bit; TCP leaves data to TCP's own checksum and sees the rest."""
    made = Prepared(case, wire)

    def flipped(request, bit):
        bad = bytearray(made.good(request))
        bad[bit // 8] ^= 1 << bit % 8
        return bad

    size = len(made.good(bytes(2)))
    for bit in range(8 * (size - len(made.read) if wire == "tcp" else size)):
        with pytest.raises(links.FrameError):
            made.answered(lambda request, bit=bit: flipped(request, bit))
    assert made.answered(made.good) == made.read


@ALL
def test_late_replies_are_not_taken_for_the_next(case):
    """TCP: a reply to the request before is a mismatch of transactions."""
    made = Prepared(case, "tcp")
    made.answered(made.good)
    late = made.good(made.link.request)
    with pytest.raises(links.MismatchError, match=r"transaction .*2, got 1"):
        made.answered(lambda _: late)


@BOTH
def test_single_write_must_echo_this_value(wire):
    """On RTU an echo of the value before cannot be told by an id, but by the value."""
    made = Prepared("single", wire)
    assert made.answered(lambda request: made.wrap(request, H("06 0007") + b"cd"), b"cd") == b""
    for other in (b"ab", OLD[:2]):
        with pytest.raises(links.MismatchError, match="must begin with"):
            made.answered(
                lambda request, other=other: made.wrap(request, H("06 0007") + other), b"cd"
            )


def test_numbers_wrap_and_are_shared_by_all_requests():
    """65535 is followed by 0."""
    link = AnsweringLink(lambda request: request[:2] + H("0000 0005 01 03 02 0007"))
    session = session_on(link, "tcp", unit=1)
    session.numbers = itertools.count(65535)
    calls = [session.prepare(read_pdu(3, 0, 1)) for _ in range(2)]
    for call, number in zip(calls * 2, (65535, 0, 1, 2), strict=True):
        assert call() == H("0007")
        assert int.from_bytes(link.request[:2], "big") == number


@BOTH
def test_replies_of_another_length_are_refused(wire):
    made = Prepared("read", wire)
    for pdu in (H("04 02 4020"), H("04 06 402000000000")):
        with pytest.raises((links.MismatchError, links.IncompleteError)):
            made.answered(lambda request, pdu=pdu: made.wrap(request, pdu))
    for tail in (b"\0", b"\0\0", b"\x55", b"again"):
        with pytest.raises((links.CorruptError, links.MismatchError)):
            made.answered(lambda request, tail=tail: made.good(request) + tail)


@pytest.mark.parametrize("case", ["read", "single", "write_read"])
def test_local_echo_of_an_adapter_is_named(case):
    made = Prepared(case, "rtu")
    for tail in (b"\x11", rtu_adu(17, b"\4\4" + REPLY)):
        with pytest.raises(links.CorruptError, match="echo"):
            made.answered(lambda request, tail=tail: request + tail)


@pytest.mark.parametrize("pdu", [read_pdu(4, 0, 1), write_pdu(9, NEW)])
def test_start_of_an_echo_is_named(pdu):
    """The reply is shorter than the request, so the exchange ends before the echo does."""
    size = reply_size(pdu) + 3
    call = session_on(AnsweringLink(lambda request: request[:size]), "rtu").prepare(pdu)
    with pytest.raises(links.CorruptError, match="echo"):
        call()


def test_an_echo_as_long_as_the_reply_is_named():
    """Two registers are written, six are read: 17 bytes each."""
    call = session_on(AnsweringLink(bytes), "rtu").prepare(write_read_pdu(0, 6, 9, NEW))
    with pytest.raises(links.CorruptError, match="echo"):
        call()


@pytest.mark.parametrize(
    "nonsense",
    ["0001 0000 F000 01 03 02", "0001 0000 0000 01 03 02", "0001 0100 0090 01 03 02"],
)
def test_nonsense_is_not_waited_for(nonsense):
    """A header that cannot be Modbus is refused at once, not after its claimed 60 kB."""
    link = AnsweringLink(lambda _: H(nonsense))
    with pytest.raises(links.CorruptError):
        session_on(link, "tcp", unit=1).prepare(read_pdu(3, 0, 1))()
    assert link.missing(H(nonsense)) == 0


@pytest.mark.parametrize("function", [1, 2])
def test_bits_of_an_odd_number_of_bytes_are_read(function):
    """17 bits are three bytes, which is no whole number of registers."""
    reply = rtu_adu(17, bytes((function, 3)) + H("A5 5A 01"))
    link = AnsweringLink(lambda _: reply)
    call = session_on(link, "rtu").prepare(read_pdu(function, 0, 17))
    assert call() == H("A5 5A 01")
    link.answer = lambda _: reply[:3] + bytes([reply[3] ^ 1]) + reply[4:]
    with pytest.raises(links.CorruptError):
        call()
