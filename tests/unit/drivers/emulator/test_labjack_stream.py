"""The emulated LabJack's stream, asked register by register as LabJack's documents describe it."""

import struct

import pytest

from hilctl_drivers.modbus.modbus_session import ModbusSession
from hilctl_drivers.modbus.pdu import read_frame, write_frame
from hilctl_drivers.profile import load_profile
from hilctl_drivers.transport.links import RefusedError
from tests.fakes import InProcess

SETTINGS = {
    4040: 1000, 4050: 256, 4060: 1, 4090: 1,  # stream-out 0: DAC0, 128 values, the last repeated
    4004: 2, 4010: 0, 4012: 128, 4016: 16, 4018: 0, 4020: 0, 4100: 0, 4102: 4800,
}  # fmt: skip


def u32(value):
    return struct.pack(">I", value)


def f32(*values):
    return struct.pack(f">{len(values)}f", *values)


class Device:
    """An emulated T7 and short words to ask it with."""

    def __init__(self, rigs=1):
        self.emulated = InProcess.of("labjack_t7", rigs=rigs)
        self.emulated.link.open()
        profile, link = load_profile("labjack_t7"), self.emulated.link
        self.feedback = ModbusSession(profile, link, 1, framing="tcp").feedback

    def write(self, address, data):
        self.feedback(write_frame(address, data))

    def read(self, address):
        return int.from_bytes(self.feedback(read_frame(address, 2))[0], "big")

    def set_up(self, rate_hz=1000.0, **changes):
        for address, value in {**SETTINGS, **changes.get("settings", {})}.items():
            self.write(address, u32(value))
        self.write(4002, f32(rate_hz))

    def play(self, *volts, number=0):
        self.feedback(
            write_frame(4400 + 2 * number, f32(*volts)), write_frame(4070 + 2 * number, u32(1))
        )

    def data(self, samples):
        """Return samples, backlog, status, what belongs to it, and the readings."""
        (data,) = self.feedback(read_frame(4500, 4 + samples))
        found = struct.unpack(f">{4 + samples}H", data)
        return *found[:4], list(found[4 : 4 + found[0]])

    def wait(self, seconds):
        self.emulated.time.sleep(seconds)


@pytest.fixture
def device():
    return Device()


@pytest.mark.parametrize(
    ("wanted_hz", "made_hz"),
    [(50_000.0, 50_000.0), (7_000.0, 1e7 / 1429), (48_000.0, 1e7 / 208), (100.0, 100.0)],
)
def test_the_scan_rate_is_rounded_to_periods_of_100_ns(device, wanted_hz, made_hz):
    device.write(4002, f32(wanted_hz))
    (found,) = struct.unpack(">f", u32(device.read(4002)))
    assert found == pytest.approx(made_hz, rel=1e-6)


def test_values_are_put_out_one_a_scan_and_the_last_is_repeated(device):
    device.set_up()
    assert device.read(4080) == 128
    device.play(2.5, 3.0, 3.5)
    assert device.read(4080) == 125
    device.write(4990, u32(1))
    device.wait(0.0021)
    assert device.read(4080) == 127
    assert device.emulated.rig.command == pytest.approx(2.0)
    device.wait(0.010)
    assert device.read(4080) == 128
    assert device.emulated.rig.command == pytest.approx(4.0)
    assert device.data(30)[0] == 12


def test_values_wait_for_set_loop(device):
    device.set_up()
    device.write(4400, f32(5.0))
    device.write(4990, u32(1))
    device.wait(0.01)
    assert device.read(4080) == 127
    assert device.emulated.rig.command == pytest.approx(0.0)


def test_a_full_buffer_drops_scans_until_it_is_emptied(device):
    """64 readings fit; the drops are told with their number once they are fetched."""
    device.set_up()
    device.play(2.5)
    device.write(4990, u32(1))
    device.wait(0.1)
    assert device.data(60)[:4] == (60, 8, 2940, 0)
    assert device.data(60)[:4] == (4, 0, 2940, 0)
    assert device.data(60) == (1, 0, 2941, 36, [0xFFFF])
    device.wait(0.0055)
    assert device.data(60)[2] == 0


SECOND = {4042: 1002, 4052: 256, 4062: 1, 4092: 1}  # stream-out 1: DAC1


class TestTwoOutputs:
    """DAC0 and DAC1 in one scan list with AIN0 and AIN1; stream-outs are numbered from 0."""

    @pytest.fixture
    def device(self):
        return Device(rigs=2)

    def commands(self, device):
        return [each.rig.command for each in device.emulated.rigs]

    def test_each_moves_its_own_rig(self, device):
        device.set_up(settings=SECOND | {4004: 4, 4102: 2, 4104: 4800, 4106: 4801})
        device.play(2.5, 3.0, 3.5)
        device.play(2.5, 2.0, number=1)
        assert (device.read(4080), device.read(4082)) == (125, 126)
        device.write(4990, u32(1))
        device.wait(0.0101)
        assert self.commands(device) == pytest.approx([0.0, 0.0])  # until the next message
        assert (device.read(4080), device.read(4082)) == (128, 128)
        assert self.commands(device) == pytest.approx([4.0, -2.0])
        count, _, status, _, readings = device.data(20)
        x, y = readings[::2], readings[1::2]
        assert (count, status) == (20, 0)
        assert x[-1] > x[0] == y[0] > y[-1]

    def test_one_of_them_streams_alone(self, device):
        """The other one keeps its value, also one written meanwhile."""
        device.set_up(settings={4040: 1002, 4100: 2})
        device.play(3.0)
        device.write(4990, u32(1))
        device.write(1000, f32(3.5))
        device.wait(0.01)
        device.read(4080)
        assert self.commands(device) == pytest.approx([4.0, 2.0])

    @pytest.mark.parametrize("settings", [
        {4004: 4, 4102: 2, 4104: 4801, 4106: 4801},  # the same one twice
        {4004: 4, 4102: 4800, 4104: 2, 4106: 4801},  # an input behind an output
        {4004: 4, 4102: 2, 4104: 4800, 4106: 4802},  # a stream-out without a target
    ])  # fmt: skip
    def test_a_scan_list_that_it_can_not_scan_is_refused(self, device, settings):
        device.set_up(settings=SECOND | settings)
        with pytest.raises(RefusedError) as refused:
            device.write(4990, u32(1))
        assert refused.value.code == 4


@pytest.mark.parametrize(("what", "code"), [
    (lambda d: d.write(4990, u32(0)), 4),  # it does not stream
    (lambda d: d.data(4), 4),
    (lambda d: (d.set_up(settings={4100: 2}), d.write(4990, u32(1))), 4),  # another input
    (lambda d: (d.set_up(settings={4016: 1}), d.write(4990, u32(1))), 4),  # to port 702
    (lambda d: (d.set_up(rate_hz=60_000.0), d.write(4990, u32(1))), 4),  # too fast for two
    (lambda d: d.set_up(settings={4050: 300}), 4),  # no power of 2
    (lambda d: (d.set_up(), d.play(*[2.5] * 40), d.play(*[2.5] * 40), d.play(*[2.5] * 49)), 4),
    (lambda d: (d.set_up(), d.play(5.1)), 3),
    (lambda d: d.write(4400, f32(1.0)), 4),  # nothing allocated
    (lambda d: (d.set_up(), d.write(4990, u32(1)), d.read(0)), 4),  # AIN0 while it streams
])  # fmt: skip
def test_what_it_can_not_do_is_refused(device, what, code):
    with pytest.raises(RefusedError) as refused:
        what(device)
    assert refused.value.code == code
