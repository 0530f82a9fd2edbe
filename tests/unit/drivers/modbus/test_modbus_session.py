"""A session with a reader on another module: self-test, steps, faults, and letting go."""

import struct

import numpy as np
import pytest

from hilctl.base.errors import DeviceError
from hilctl_drivers.emulator.faults import parse_fault
from hilctl_drivers.modbus.modbus_dac import ModbusDac
from hilctl_drivers.modbus.modbus_session import ModbusSession
from hilctl_drivers.modbus.register_map import EnsureStep, ExpectStep, WriteStep
from hilctl_drivers.profile import load_profile
from hilctl_drivers.profile_base import WaitStep


def exchange(device: ModbusDac, value: float) -> float:
    displacement_um = np.full(1, np.nan)
    device.exchange(0, np.array([value]), displacement_um, np.full(1, np.nan))
    return float(displacement_um[0])


class Line:
    """A device over Modbus TCP with coils and registers at any address."""

    name = "line"

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
    """Steps of a profile over a link whose framing is another than the profile's."""

    @pytest.fixture
    def session(self, reader):
        self.line, self.slept_s = Line(), []
        profile = load_profile(reader)
        return ModbusSession(profile, self.line, 9, self.slept_s.append, framing="tcp")

    def test_each_kind_of_register_has_its_function(self, session):
        """Devices that know one function only are common: a single word goes by the simple one."""
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
    """What is done with the reader itself."""

    def test_self_test_comes_before_anything_moves(self, serve):
        """Another module at the reader's unit id is found out, and named."""
        served = serve("adam_4024", "adam_4117")
        words, _ = served.emulator.reader.memory._readable["holding", 210]
        words.words[:] = [0x4018]
        said = r"at /dev/pts/\d+: reader adam_4117, unit 2 at /dev/pts/\d+: self-test .* \(to open"
        with pytest.raises(DeviceError, match=said):
            served.device().open(5.0, 1)
        assert served.events() == []

    def test_init_and_close_steps_are_carried_out(self, serve, reader):
        """The reader is set up before the first sample, and let go of after the last."""
        served = serve("adam_4024", reader)
        state, _ = served.emulator.reader.memory._readable["holding", 7]
        device = served.device(baud=115200)
        device.open(5.0, 1)
        assert state.words == [1]
        exchange(device, 1.0)
        device.close()
        assert state.words == [2]

    def test_expectations_are_checked(self, serve):
        """An input that is set to another range than the profile's is refused."""
        served = serve("waveshare_ao_8ch", "waveshare_ai_8ch")
        words, _ = served.emulator.reader.memory._readable["holding", 0x1000]
        words.words[:] = [3]
        with pytest.raises(DeviceError, match=r"reader waveshare_ai_8ch.* 0 to 20 mA\)"):
            served.device().open(5.0, 1)

    @pytest.mark.parametrize(
        ("fault", "said"),
        [({"mute": frozenset({4})}, "no answer"), ({"lacking": frozenset({4})}, "exception 1")],
    )
    def test_input_that_can_not_be_read_moves_nothing(self, serve, fault, said):
        """It is read once at opening, before the first write."""
        served = serve("icp_m7024", "icp_m7017", **fault)
        with pytest.raises(DeviceError, match=rf": reader icp_m7017, .*{said}.* \(to open\)"):
            served.device(timeout_s=2.0).open(5.0, 1)
        assert served.events() == []

    @pytest.mark.parametrize(
        ("fault", "said", "timeout_s"),
        [("silence@1s", "no answer", 2.0), ("exception@1s", "exception 4", 20.0)],
    )
    def test_errors_name_the_reader(self, serve, fault, said, timeout_s):
        """The message says which device, where, and what was being done; nothing was written."""
        served = serve("icp_m7024", "icp_m7017", faults=(parse_fault(fault),))
        device = served.device(timeout_s=timeout_s)
        device.open(5.0, 1)
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
        """A write that is refused is told of the device itself, at opening."""
        served = serve("icp_m7024", "icp_m7017", lacking=frozenset({6}))
        with pytest.raises(DeviceError, match="function 6 refused with exception 1") as refused:
            served.device().open(5.0, 1)
        assert "reader" not in str(refused.value)

    def test_both_lines_are_let_go_of(self, serve):
        """After an error in the one, neither port is kept for longer than the safe value needs."""
        faults = (parse_fault("silence@1s"),)
        served = serve("icp_m7024", "icp_m7017", reader_line="own", faults=faults)
        device, other = served.device(timeout_s=2.0), served.device(timeout_s=2.0)
        device.open(5.0, 1)
        with pytest.raises(DeviceError, match="can't be opened"):
            other.open(5.0, 1)
        served.clock.pass_s(2.0)
        with pytest.raises(DeviceError, match="reader icp_m7017"):
            exchange(device, 1.0)
        device.make_safe(0.0)
        other.open(5.0, 1)
        other.close()

    def test_no_reader_there_moves_nothing(self, serve):
        """A reader that can't be reached is told at opening, by its own address."""
        served = serve("adam_6224", "adam_6217")
        said = r"reader adam_6217, unit 1 at 127\.0\.0\.1:1: can't connect: .* \(to open\)"
        with pytest.raises(DeviceError, match=said):
            served.device(reader={**served.emulator.options["reader"], "tcp_port": 1}).open(5.0, 1)
        assert served.events() == []
