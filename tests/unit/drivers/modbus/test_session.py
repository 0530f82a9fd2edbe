"""A session with a reader on another module: self-test, steps, faults, and letting go."""

import numpy as np
import pytest

from hilctl.base.errors import DeviceError
from hilctl_drivers.emulator.faults import parse_fault
from hilctl_drivers.modbus.device import ModbusDac


def exchange(device: ModbusDac, value: float) -> float:
    displacement_um = np.full(1, np.nan)
    device.exchange(0, np.array([value]), displacement_um, np.full(1, np.nan))
    return float(displacement_um[0])


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
            served.device(timeout_s=0.2).open(5.0, 1)
        assert served.events() == []

    @pytest.mark.parametrize(
        ("fault", "said"), [("silence@1s", "no answer"), ("exception@1s", "exception 4")]
    )
    def test_errors_name_the_reader(self, serve, fault, said):
        """The message says which device, where, and what was being done; nothing was written."""
        served = serve("icp_m7024", "icp_m7017", faults=(parse_fault(fault),))
        device = served.device(timeout_s=0.2)
        device.open(5.0, 1)
        served.clock.pass_s(2.0)
        named = rf"modbus_dac icp_m7024 at .*: reader icp_m7017, unit 2 at .*: .*{said}.* \(to wri"
        with pytest.raises(DeviceError, match=named):
            exchange(device, 1.0)
        assert served.events() == []
        with pytest.raises(DeviceError, match="not open"):
            exchange(device, 1.0)
        device.make_safe(0.0)
        assert served.events()[-1]["current_a"] == pytest.approx(0.0, abs=1e-3)

    def test_errors_of_the_one_that_drives_are_not_the_readers(self, serve):
        """A write that is refused is told of the device itself."""
        served = serve("icp_m7024", "icp_m7017", lacking=frozenset({6}))
        device = served.device()
        device.open(5.0, 1)
        with pytest.raises(DeviceError, match="exception 1") as refused:
            exchange(device, 1.0)
        assert "reader" not in str(refused.value)

    def test_both_lines_are_let_go_of(self, serve):
        """After an error in the one, neither port is kept."""
        faults = (parse_fault("silence@1s"),)
        served = serve("icp_m7024", "icp_m7017", reader_line="own", faults=faults)
        device, other = served.device(timeout_s=0.2), served.device(timeout_s=0.2)
        device.open(5.0, 1)
        with pytest.raises(DeviceError, match="can't be opened"):
            other.open(5.0, 1)
        served.clock.pass_s(2.0)
        with pytest.raises(DeviceError, match="reader icp_m7017"):
            exchange(device, 1.0)
        other.open(5.0, 1)
        other.close()

    def test_no_reader_there_moves_nothing(self, serve):
        """A reader that can't be reached is told at opening, by its own address."""
        served = serve("adam_6224", "adam_6217")
        said = r"reader adam_6217, unit 1 at 127\.0\.0\.1:1: can't connect: .* \(to open\)"
        with pytest.raises(DeviceError, match=said):
            served.device(reader={**served.emulator.options["reader"], "tcp_port": 1}).open(5.0, 1)
        assert served.events() == []
