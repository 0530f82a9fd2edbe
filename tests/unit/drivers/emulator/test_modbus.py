"""The emulated Modbus device: rig, registers, watchdog, wire and faults, with time injected."""

import json
import re
import signal
import socket
import threading
from collections.abc import Callable, Iterator

import numpy as np
import pytest
from pymodbus.client import ModbusTcpClient

from hilctl.base.errors import InputError
from hilctl_drivers.emulator.emulated import Declined, EmulatedDevice
from hilctl_drivers.emulator.faults import KINDS, Fault, FaultPlan, parse_fault, spoil
from hilctl_drivers.emulator.main import serve
from hilctl_drivers.emulator.modbus_bench import EmulatorOptions, build
from hilctl_drivers.emulator.modbus_wire import ModbusWire
from hilctl_drivers.emulator.rig import RATE_HZ, Rig
from hilctl_drivers.emulator.wiring import Wiring
from hilctl_drivers.emulator.write_log import WriteLog
from hilctl_drivers.modbus.pdu import (
    feedback_pdu,
    read_pdu,
    reply_data,
    rtu_adu,
    rtu_pdu,
    tcp_adu,
    tcp_pdu,
    write_pdu,
    write_read_pdu,
    write_single_pdu,
)
from hilctl_drivers.modbus.registers import RegisterFormat
from hilctl_drivers.profile import load_profile
from hilctl_drivers.simulated.terfenol import TerfenolActuator, TerfenolParameters
from hilctl_drivers.wire.errors import Refused

FLOAT32 = RegisterFormat("float32")
MS = 1_000_000


def emulated(name: str, output: str, sensor: str) -> EmulatedDevice:
    return EmulatedDevice(load_profile(name), Rig(0), WriteLog(None, 0), output, sensor)


@pytest.fixture
def t7() -> ModbusWire:
    """An emulated T7 behind Modbus TCP."""
    return ModbusWire("tcp", emulated("labjack_t7", "DAC0", "AIN0"))


def ask(wire: ModbusWire, pdu: bytes, now_ns: int = 0) -> bytes:
    """Send a request over TCP framing and return the checked reply's data."""
    used, request = wire.take(tcp_adu(7, 1, pdu))
    assert used
    return reply_data(pdu, tcp_pdu(wire.answer(request, now_ns), 7, 1))


class TestRig:
    """The rig's own sample clock."""

    def test_is_the_actuator_on_its_own_clock(self):
        """Asked at odd times, it shows the samples of an undisturbed run, noise included."""
        rig = Rig(5 * MS)
        rig.put_out(3.0, 5 * MS)
        shown = []
        for k in range(1, 200):
            rig.advance(5 * MS + k * 137_000)
            shown.append(rig.displacement_um)
        plant = TerfenolActuator(TerfenolParameters(), RATE_HZ)
        command = np.concatenate([np.zeros(1), np.full(400, 3.0)])
        read = np.empty((2, command.size))
        plant.step(command, read[0], read[1])
        due = [int(k * 137_000 * 1e-9 * RATE_HZ) for k in range(1, 200)]
        assert shown == [read[0, max(0, k - 1)] for k in due]

    def test_time_does_not_go_back(self):
        """Being asked twice for the same moment changes nothing."""
        rig = Rig(0)
        rig.put_out(2.0, MS)
        rig.advance(2 * MS)
        before = rig.displacement_um
        rig.advance(2 * MS)
        rig.advance(MS)
        assert rig.displacement_um == before

    def test_long_silence_costs_no_more_than_settling(self):
        """After hours the rig has settled, and is not simulated through all of them."""
        rig = Rig(0, noise=False)
        rig.put_out(2.0, 0)
        rig.advance(24 * 3600 * 1000 * MS)
        settled = rig.displacement_um
        rig.advance(25 * 3600 * 1000 * MS)
        assert rig.displacement_um == pytest.approx(settled, abs=1e-2)

    def test_amplifier_saturates(self):
        """Beyond its range the amplifier gives what it can, as amplifiers do."""
        rig = Rig(0)
        rig.put_out(50.0, 0)
        assert rig.current_a == 10.0


class TestWire:
    """Requests as pymodbus takes them apart, replies as our framing takes them apart."""

    def test_write_moves_and_read_shows(self, t7):
        """Function 16 puts out, functions 3 and 4 read the same on a LabJack."""
        ask(t7, write_pdu(1000, FLOAT32.encode(3.25)))
        volts = [FLOAT32.decode(ask(t7, read_pdu(f, 0, 2), 10 * MS)) for f in (3, 4)]
        assert volts[0] == volts[1]
        assert 12.5 * volts[0] == pytest.approx(16.5, abs=1.0)
        assert FLOAT32.decode(ask(t7, read_pdu(3, 1000, 2))) == 3.25

    def test_feedback_reads_before_the_command_acts(self, t7):
        """Function 76 writes and reads in one; the reading is of the moment of the write."""
        pdu = feedback_pdu(1000, FLOAT32.encode(4.0), 0, 2)
        first = FLOAT32.decode(ask(t7, pdu))
        second = FLOAT32.decode(ask(t7, pdu, 10 * MS))
        assert abs(12.5 * first) < 0.5
        assert 12.5 * second > 5.0

    def test_coupler_reads_elsewhere_than_it_writes(self):
        """On a WAGO register 0 is written as output and read as input; 0x200 reads it back."""
        wire = ModbusWire("tcp", emulated("wago_750", "AO0", "AI0"))
        raw = (8000).to_bytes(2, "big")
        assert abs(int.from_bytes(ask(wire, write_read_pdu(0, 1, 0, raw)), "big", signed=True)) < 90
        assert ask(wire, read_pdu(3, 0x200, 1)) == raw
        ask(wire, write_single_pdu(0, raw))
        assert ask(wire, read_pdu(3, 0, 1), 10 * MS) != raw

    @pytest.mark.parametrize(
        ("pdu", "code"),
        [
            (read_pdu(3, 12345, 1), 2),
            (read_pdu(3, 0, 9), 2),
            (write_pdu(0, FLOAT32.encode(1.0)), 2),
            (write_pdu(1000, b"\x00\x00"), 2),
            (write_pdu(1000, FLOAT32.encode(5.1)), 3),
            (write_pdu(1000, FLOAT32.encode(-0.1)), 3),
            (write_pdu(1000, b"\x7f\xc0\x00\x00"), 3),
            (write_pdu(1000, FLOAT32.encode(1.0) + FLOAT32.encode(9.0)), 3),
            (write_read_pdu(0, 2, 1000, FLOAT32.encode(1.0)), 1),
        ],
    )
    def test_refusals_change_nothing(self, t7, pdu, code):
        """Wrong addresses, parts of values, values out of range, unknown functions."""
        ask(t7, write_pdu(1000, FLOAT32.encode(2.0)))
        with pytest.raises(Refused) as refusal:
            ask(t7, pdu)
        assert refusal.value.code == code
        assert FLOAT32.decode(ask(t7, read_pdu(3, 1000, 2))) == 2.0

    def test_requests_in_one_segment_are_all_answered(self, t7):
        """The second of two is not lost, and half of one waits for the rest."""
        pdu = read_pdu(3, 1000, 2)
        both = tcp_adu(1, 1, pdu) + tcp_adu(2, 1, pdu)
        used, first = t7.take(both)
        assert used == len(both) // 2
        rest, second = t7.take(both[used:])
        assert rest == used
        replies = [t7.answer(request, 0) for request in (first, second)]
        assert [int.from_bytes(reply[:2], "big") for reply in replies] == [1, 2]
        assert t7.take(both[:5]) == (0, b"")

    def test_rtu_ignores_others_and_rubbish(self):
        """Another unit's request and a spoilt one get no reply."""
        wire = ModbusWire("rtu", emulated("wago_750", "AO0", "AI0"))
        pdu = read_pdu(3, 0x200, 1)
        good = rtu_adu(1, pdu)
        _, request = wire.take(good)
        assert len(reply_data(pdu, rtu_pdu(wire.answer(request, 0), 1))) == 2
        assert wire.take(rtu_adu(2, pdu))[1] == b""
        assert wire.take(good[:-1] + bytes([good[-1] ^ 1]))[1] == b""

    def test_units_share_a_line_and_a_rig(self):
        """One unit drives, the other shows; neither has the other's registers."""
        rig, log, wiring = Rig(0), WriteLog(None, 0), Wiring(1.0, 0.0, 12.5, 0.0)
        drives = EmulatedDevice(load_profile("adam_4024"), rig, log, "AO0", None, wiring)
        reads = EmulatedDevice(load_profile("adam_4117"), rig, log, None, "AI2", wiring)
        wire = ModbusWire("rtu", {1: drives, 2: reads})

        def transact(unit: int, pdu: bytes, now_ns: int) -> bytes:
            _, request = wire.take(rtu_adu(unit, pdu))
            return reply_data(pdu, rtu_pdu(wire.answer(request, now_ns), unit))

        transact(1, write_single_pdu(0, (4095).to_bytes(2, "big")), 0)
        raw = int.from_bytes(transact(2, read_pdu(3, 2, 1), 10 * MS), "big")
        assert 12.5 * (raw * 20.0 / 65535.0 - 10.0) == pytest.approx(rig.displacement_um, abs=0.01)
        assert rig.displacement_um > 40.0
        with pytest.raises(Refused):
            transact(2, write_single_pdu(0, bytes(2)), 10 * MS)
        assert wire.take(rtu_adu(3, read_pdu(3, 0, 1)))[1] == b""

    def test_gateway_says_that_a_unit_is_not_there(self):
        """Over TCP a unit that nobody has is exception 11; one device alone takes any unit."""
        device = emulated("labjack_t7", "DAC0", "AIN0")
        pdu = read_pdu(3, 1000, 2)
        wire = ModbusWire("tcp", {1: device, 2: emulated("labjack_t7", "DAC0", "AIN0")})
        _, request = wire.take(tcp_adu(7, 3, pdu))
        with pytest.raises(Refused) as refusal:
            reply_data(pdu, tcp_pdu(wire.answer(request, 0), 7, 3))
        assert refusal.value.code == 11
        alone = ModbusWire("tcp", device)
        _, request = alone.take(tcp_adu(7, 3, pdu))
        assert len(reply_data(pdu, tcp_pdu(alone.answer(request, 0), 7, 3))) == 4

    def test_unknown_channels_are_refused(self):
        """The message says which there are."""
        with pytest.raises(InputError, match="DAC9 and AIN0: outputs DAC0, DAC1"):
            emulated("labjack_t7", "DAC9", "AIN0")

    def test_decline_carries_the_code(self):
        """What a device declines becomes that exception reply."""
        device = emulated("labjack_t7", "DAC0", "AIN0")
        with pytest.raises(Declined) as declined:
            device.read(["holding"], 9999, 1)
        assert declined.value.code == 2


class TestFaults:
    """When and how things go wrong."""

    @pytest.mark.parametrize("kind", KINDS)
    def test_texts_are_read(self, kind):
        """A count, a time, and how late."""
        assert parse_fault(f"{kind}@12") == Fault(kind, at_count=12)
        assert parse_fault(f"{kind}@2.5s") == Fault(kind, at_s=2.5)
        if kind == "delay":
            assert parse_fault("delay:0.3@1") == Fault("delay", at_count=1, delay_s=0.3)

    @pytest.mark.parametrize(
        ("text", "words"),
        [
            ("silence", "KIND@COUNT"),
            ("noise@1", "must be one of silence"),
            ("reset:2@1", "only delay"),
            ("reset@0", "whole number from 1"),
            ("reset@1.5", "whole number from 1"),
            ("", "KIND@COUNT"),
        ],
    )
    def test_nonsense_is_refused(self, text, words):
        """The message says how to write it."""
        with pytest.raises(InputError, match=words):
            parse_fault(text)

    def test_each_happens_once_when_it_is_due(self):
        """By count or by time, whichever comes."""
        plan = FaultPlan([parse_fault("cut@2"), parse_fault("reset@1s")])
        seen = [plan.next(elapsed_s) for elapsed_s in (0.0, 0.5, 0.9, 1.0, 2.0)]
        assert [fault.kind if fault else None for fault in seen] == [
            None, "cut", None, "reset", None,
        ]  # fmt: skip
        assert plan.count == 5

    def test_bytes_are_spoilt_as_said(self):
        """One byte changed, half left out, all sent twice."""
        reply = bytes(range(8))
        assert spoil("corrupt", reply, 3) == bytes([0, 1, 2, 3 ^ 0x10, 4, 5, 6, 7])
        assert spoil("cut", reply, 3) == reply[:4]
        assert spoil("duplicate", reply, 3) == reply + reply
        assert spoil("delay", reply, 3) == reply


@pytest.fixture
def served() -> Iterator[Callable[..., str]]:
    """Serve emulators in threads; yield a function that starts one and returns its address."""
    running = []

    def start(profile: str, **options) -> str:
        emulator = build(EmulatorOptions(profile, **options))
        thread = threading.Thread(target=emulator.server.run)
        thread.start()
        running.append((emulator, thread))
        return emulator.address

    yield start
    for emulator, thread in running:
        emulator.server.stop()
        thread.join()
        emulator.log.close()


class TestServer:
    """Sockets and ptys."""

    def test_independent_client_agrees(self, served):
        """pymodbus's client reads and writes the emulated device, with its own conversions."""
        host, port = served("labjack_t7").split(":")
        with ModbusTcpClient(host, port=int(port), retries=0) as client:
            kind = client.DATATYPE.FLOAT32
            client.write_registers(1000, client.convert_to_registers(4.25, kind))
            back = client.read_holding_registers(1000, count=2).registers
            assert client.convert_from_registers(back, kind) == 4.25
            test = client.read_input_registers(55100, count=2).registers
            assert test == [0x0011, 0x2233]
            assert client.read_holding_registers(9999, count=1).exception_code == 2

    def test_pipelined_requests_are_answered_in_order(self, served):
        """Two requests in one segment get two replies."""
        host, port = served("labjack_t7").split(":")
        pdu = read_pdu(3, 1000, 2)
        with socket.create_connection((host, int(port)), 5.0) as link:
            link.sendall(tcp_adu(1, 1, pdu) + tcp_adu(2, 1, pdu))
            got = b""
            while len(got) < 26:
                got += link.recv(100)
        assert (got[:2], got[13:15]) == (b"\x00\x01", b"\x00\x02")

    def test_port_in_use_is_one_line(self, served):
        """The message says which port, and nothing is left open."""
        address = served("labjack_t7")
        with pytest.raises(InputError, match=f"can't listen on {address}"):
            served("labjack_t7", port=int(address.split(":")[1]))

    @pytest.mark.parametrize(
        ("profile", "options", "words"),
        [
            ("waveshare_ao_8ch", {}, "has no input to show a displacement at: name a reader"),
            ("waveshare_ai_8ch", {}, "has no output to drive .*: it can be another one's reader"),
            ("adam_4024", {"reader": "kepco_bop"}, "kepco_bop: only Modbus profiles"),
            ("adam_4024", {"reader": "adam_4117", "sensor": "AI9"}, "4117 .* has no AI9: AI0, AI1"),
            ("adam_4024", {"reader": "adam_4117", "output": "AI0"}, "4024 .* has no AI0: AO0, AO1"),
            ("adam_4024", {"reader": "adam_4117", "reader_unit_id": 1}, "reader_unit_id must not"),
            ("wago_750", {"link": "rtu", "faults": (Fault("reset", at_count=1),)}, "is for tcp"),
        ],
    )
    def test_what_can_not_be_emulated_is_refused(self, served, profile, options, words):
        """Half a bench, channels that are not there, one unit id twice, faults of another link."""
        with pytest.raises(InputError, match=words):
            served(profile, **options)

    @pytest.mark.parametrize(
        ("options", "words"),
        [
            ({"link": "pigeon"}, "link must be one of tcp, rtu, got 'pigeon'"),
            ({"reader_line": "other"}, "reader_line must be one of same, own, got 'other'"),
        ],
    )
    def test_words_that_mean_nothing_are_refused(self, options, words):
        """The message lists those that do."""
        with pytest.raises(InputError, match=words):
            serve("wago_750", **options)

    @pytest.mark.parametrize(
        ("profile", "reader", "options", "places"),
        [
            ("adam_4024", "adam_4117", {}, r"(/dev/pts/\d+), unit 1 \1, unit 2"),
            ("adam_4024", "adam_4117", {"reader_unit_id": 7}, r"(/dev/\S+), unit 1 \1, unit 7"),
            ("adam_6224", "adam_6217", {}, r"127.0.0.1:(\d+), unit 1 127.0.0.1:(?!\1)\d+, unit 1"),
            ("kepco_bop", "agilent_34970a", {}, r"(/dev/pts/\d+) (?!\1)/dev/pts/\d+"),
        ],
    )
    def test_it_says_where_both_answer(self, profile, reader, options, places):
        """Each with its place, and its unit id where there is one; a signal ends it."""
        told: list[tuple[str, str]] = []

        def on_ready(name: str, address: str) -> None:
            told.append((name, address))
            if len(told) == 2:
                signal.raise_signal(signal.SIGTERM)

        serve(profile, reader=reader, on_ready=on_ready, **options)
        assert [name for name, _ in told] == [profile, reader]
        assert re.fullmatch(places, " ".join(address for _, address in told))

    def test_a_line_of_text_has_no_modbus_reader(self):
        """Units and ports of a reader are for Modbus; a text device's has a line of its own."""
        with pytest.raises(InputError, match="are for Modbus profiles, kepco_bop has a line"):
            serve("kepco_bop", reader="agilent_34970a", reader_unit_id=2)

    def test_second_port_in_use_leaves_nothing_open(self, served):
        """What was opened before the refusal is let go of."""
        port = int(served("labjack_t7").split(":")[1])
        with pytest.raises(InputError, match=f"can't listen on 127.0.0.1:{port}"):
            served("adam_6224", reader="adam_6217", reader_port=port)

    def test_log_tells_time_and_value(self, served, tmp_path):
        """Each write is one JSON object with both clocks, on disk at once."""
        path = tmp_path / "log.jsonl"
        host, port = served("labjack_t7", log=path).split(":")
        with ModbusTcpClient(host, port=int(port), retries=0) as client:
            client.write_registers(1000, [0x4020, 0x0000])
        entry = json.loads(path.read_text())
        assert entry["event"] == "write"
        assert (entry["output"], entry["value"], entry["current_a"]) == ("DAC0", 2.5, 0.0)
        assert entry["monotonic_ns"] > 0
        assert entry["unix_s"] > 1.7e9

    def test_log_that_can_not_be_written_is_refused(self, served, tmp_path):
        """A folder that is not there is told before anything is served."""
        with pytest.raises(InputError, match="can't be written"):
            served("labjack_t7", log=tmp_path / "none" / "log.jsonl")
