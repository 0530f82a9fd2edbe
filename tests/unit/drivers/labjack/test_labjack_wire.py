"""``modbus_stream`` against an emulated LabJack in this process, in a time that tests make pass."""

import re
import struct
from contextlib import nullcontext
from dataclasses import dataclass, replace

import numpy as np
import pytest

from hilctl.base.errors import DeviceError, InputError
from hilctl_drivers.dac import ModbusStream, ModbusStreamOptions
from hilctl_drivers.labjack import stream
from hilctl_drivers.labjack.labjack_wire import StreamSession, stream_time
from hilctl_drivers.profile import load_profile
from hilctl_drivers.simulated.terfenol import TerfenolActuator, TerfenolParameters
from tests.fakes import T7_OPTIONS, FaultyLink, InProcess, InProcessLink, logged

RATE_HZ = 10_000.0
BLOCK = 100
FIFO_BLOCKS = 5
MESSAGE_S = 0.0003
LSB_UM = 0.0003158058 * 12.5
PATTERN = b"\xcc\x04"


def options(**changes):
    made = {**T7_OPTIONS, "host": "127.0.0.1", "fifo_blocks": FIFO_BLOCKS, **changes}
    return ModbusStreamOptions.model_validate(made)


class DrivenStream:
    """A streaming device that is wired to an emulated LabJack."""

    def __init__(self, emulated, log, chosen):
        self.emulated = emulated
        self.time = emulated.time
        self.link = emulated.link
        self._log = log
        self.device = emulated.stream(chosen)
        self.sent = 0

    def open(self, rate_hz=RATE_HZ, block=BLOCK):
        """Open and arm it, as a run does."""
        self.device.open(rate_hz, block)
        self.device.arm()
        self.sent = 0

    def exchange(self, command):
        """Send one block; return the displacements that came back with it."""
        displacement_um, measured = np.full(command.size, np.nan), np.full(command.size, np.nan)
        self.device.exchange(self.sent, command, displacement_um, measured)
        self.sent += command.size
        return displacement_um

    def hold(self, command, blocks):
        return [self.exchange(np.full(BLOCK, float(command))) for _ in range(blocks)]

    def events(self):
        return logged(self._log)

    @property
    def clock(self):
        """The emulated device's scan clock."""
        return self.emulated.device.overlay.fifo


@pytest.fixture
def driven(tmp_path):
    """Return a function that wires a streaming device to an emulated LabJack."""
    made = []

    def of(link=InProcessLink, message_s=MESSAGE_S, current_a=0.0, **changes):
        chosen = options(**changes)
        log = tmp_path / f"log{len(made)}.jsonl"
        emulated = InProcess.of(
            chosen.profile.name, link=link, log=log, message_s=message_s, current_a=current_a
        )
        made.append(DrivenStream(emulated, log, chosen))
        return made[-1]

    yield of
    for each in made:
        each.emulated.log.close()


def sine(n, frequency_hz=50.0, rate_hz=RATE_HZ):
    return 3.0 * np.sin(2 * np.pi * frequency_hz * np.arange(n) / rate_hz)


def alone(commands, rate_hz=RATE_HZ):
    """Return what the same actuator does with float32 volts sample by sample, without noise."""
    volts = ((commands + 10.0) / 4.0).astype(np.float32).astype(np.float64)
    actuator = TerfenolActuator(replace(TerfenolParameters(), sensor_noise_um=0.0), rate_hz)
    found, measured = np.empty(commands.size), np.empty(commands.size)
    actuator.step(volts * 4.0 - 10.0, found, measured)
    return found


@pytest.mark.parametrize("channels", [0, 2])
@pytest.mark.parametrize("profile", ["labjack_t7", "labjack_t4"])
def test_each_displacement_belongs_to_its_command(driven, profile, channels):
    inputs = load_profile(profile).streaming.inputs[1 : 1 + channels]
    aux = {f"aux_{name}": {"input": name, "scale": 9.0, "offset": 25.0} for name in inputs}
    made = driven(profile=profile, aux=aux)
    made.open()
    commands = sine(20 * BLOCK)
    back = [made.exchange(part) for part in np.split(commands, 20)]
    assert np.isnan(np.concatenate(back[:FIFO_BLOCKS])).all()
    found = np.concatenate(back[FIFO_BLOCKS:])
    assert found == pytest.approx(alone(commands[: found.size]), abs=0.51 * LSB_UM * 1.03)
    output_v = (commands[found.size - BLOCK : found.size].mean() + 10.0) / 4.0
    assert made.device.aux.tolist() == pytest.approx([9.0 * output_v + 25.0] * channels, abs=0.01)
    per_s = load_profile(profile).streaming.samples_per_s_max
    assert made.device.info.max_rate_hz == pytest.approx(per_s / (2 + channels))


def test_nothing_moves_before_the_fifo_is_filled(driven):
    made = driven()
    made.open()
    made.hold(2.0, FIFO_BLOCKS - 1)
    made.time.sleep(1.0)
    assert not made.clock.running
    assert [each["current_a"] for each in made.events()] == pytest.approx([0.0])
    made.hold(2.0, 1)
    assert made.clock.running


def test_the_device_keeps_the_pace(driven):
    made = driven()
    made.open()
    made.hold(1.0, FIFO_BLOCKS)
    before = made.time()
    made.hold(1.0, 50)
    assert made.time() - before == pytest.approx(50 * BLOCK / RATE_HZ, rel=0.01)
    assert made.device.wire.buffer.level_min > (FIFO_BLOCKS - 1.1) * BLOCK
    assert made.clock.underruns == 0


def test_a_stall_of_this_machine_costs_fifo_and_no_sample(driven):
    made = driven()
    made.open()
    made.hold(1.0, 10)
    made.time.sleep(0.035)
    assert all(np.isfinite(each).all() for each in made.hold(1.0, 20))
    assert made.clock.underruns == 0
    made.device.close()
    assert not made.clock.running


def test_an_underrun_is_told_with_its_length(driven):
    made = driven()
    made.open()
    made.hold(1.0, 10)
    made.time.sleep(0.080)
    with pytest.raises(DeviceError, match=r"underrun: .* (\d+) sample") as e:
        made.hold(1.0, 1)
    told = int(re.search(r"(\d+) sample", str(e.value))[1])
    assert told == made.clock.underruns
    assert 250 <= told <= 350
    made.device.make_safe(0.0)
    assert made.events()[-1]["current_a"] == pytest.approx(0.0, abs=1e-9)


class Spoiled(InProcessLink):
    """Changes every reply in a way that a test wants."""

    change = staticmethod(lambda reply: reply)

    def spoil(self, reply):
        return self.change(reply)

    def open(self):
        super().open()
        self.change = lambda reply: reply


@pytest.mark.parametrize(("change", "text"), [
    (lambda r: r[:-1], "only 259 bytes"),
    (lambda r: r + b"\0", "1 bytes"),
    (lambda r: b"\x55" + r[1:], "transaction must be"),
    (lambda r: r[:3] + b"\1" + r[4:], "not a Modbus TCP header"),
    (lambda r: r[:5] + b"\3" + r[6:7] + PATTERN, r"exception 4 \(device failure\)"),
    (lambda r: r[:12] + b"\x0b\x7c" + r[14:], "it drops scans"),
])  # fmt: skip
def test_a_bad_answer_is_an_error_and_the_output_can_still_be_made_safe(driven, change, text):
    made = driven(link=Spoiled)
    made.open()
    made.hold(2.0, 8)
    made.link.change = change
    with pytest.raises(DeviceError, match=text):
        made.hold(2.0, 1)
    made.device.make_safe(0.0)
    assert not made.clock.running
    assert made.events()[-1]["current_a"] == pytest.approx(0.0, abs=1e-9)
    made.open()
    made.hold(0.0, 8)


def test_a_silent_host_is_noticed_by_the_device(driven):
    made = driven(watchdog={"timeout_s": 2.0, "safe_command": -1.0})
    made.open()
    made.hold(2.0, 10)
    made.time.sleep(3.0)
    with pytest.raises(DeviceError, match="function 76 refused"):
        made.hold(2.0, 1)
    last = made.events()[-1]
    assert (last["event"], last["current_a"]) == ("watchdog", pytest.approx(-1.0))
    made.device.make_safe(0.0)
    assert made.events()[-1]["current_a"] == pytest.approx(0.0, abs=1e-9)


def test_samples_follow_one_another(driven):
    made = driven()
    made.open()
    made.hold(1.0, 2)
    made.sent += BLOCK
    with pytest.raises(DeviceError, match=r"200 .* got 300"):
        made.hold(1.0, 1)


@pytest.mark.parametrize(("rate_hz", "block", "changes", "text"), [
    (RATE_HZ, 1366, {}, "block must be 1 to 1365.*8192 samples, got 1366"),
    (RATE_HZ, 0, {}, "block must be 1 to 1365"),
    (50.0, 10, {}, r"sample rate must be in \[100, .*got 50"),
    (50_001.0, 580, {}, r"sample rate must be in \[100, 50000\] Hz .*580 samples in"),
    (40_000.0, 58, {}, r"in \[100, 29000\] Hz .*58 samples in 2 messages.*turnaround 2.00 ms"),
    (7_000.0, 100, {}, "scan rate was set to 7000 Hz, the device makes 6997.9"),
    (100.0, 100, {"watchdog": {"timeout_s": 2.0}}, "3 exchanges must come within"),
])  # fmt: skip
def test_what_the_device_can_not_do_is_refused_at_open(driven, rate_hz, block, changes, text):
    made = driven(**changes)
    with pytest.raises(DeviceError, match=text):
        made.device.open(rate_hz, block)
    assert all(each["current_a"] == pytest.approx(0.0) for each in made.events())
    assert not made.clock.running


def test_a_stream_of_an_earlier_run_is_stopped(driven):
    made = driven()
    made.open()
    made.hold(2.0, 10)
    again = DrivenStream(made.emulated, made._log, options())
    again.open()
    assert not again.clock.running
    found = again.hold(2.0, FIFO_BLOCKS + 2)
    assert np.isfinite(found[-1]).all()
    assert again.clock.underruns == 0


def test_one_message_stops_the_stream_and_writes_the_safe_value(driven):
    made = driven(link=FaultyLink)
    made.open()
    made.hold(2.0, 10)
    before_s, sent = made.time(), len(made.link.requests)
    made.device.make_safe(-1.0)
    last = made.events()[-1]
    assert (last["event"], last["current_a"]) == ("write", pytest.approx(-1.0))
    assert last["monotonic_ns"] * 1e-9 - before_s == pytest.approx(MESSAGE_S)
    assert len(made.link.requests) - sent == 2  # the other one reads it back
    assert not made.clock.running


def test_stream_that_is_started_late_is_stopped_by_the_next_attempt(driven):
    """The message that starts it timed out, and is executed after the safe value."""
    made = driven(link=FaultyLink)
    made.open()
    made.hold(4.0, FIFO_BLOCKS - 1)
    made.link.late_if = lambda request: struct.pack(">BHB", 1, stream.ENABLE, 2) in request
    made.link.late_s = 0.4
    with pytest.raises(DeviceError, match="no answer"):
        made.hold(4.0, 1)
    made.device.make_safe(0.0)
    made.time.sleep(0.5)
    made.link.deliver()
    assert made.clock.running
    made.device.make_safe(0.0)
    made.time.sleep(60.0)
    made.emulated.device.tick(made.time.now_ns)
    assert made.emulated.rig.command == pytest.approx(0.0, abs=1e-9)
    assert not made.clock.running


def test_the_watchdog_does_not_count_before_it_is_armed(driven):
    made = driven(watchdog={"timeout_s": 2.0})
    made.device.open(RATE_HZ, BLOCK)
    made.time.sleep(60.0)
    assert made.events()[-1]["event"] != "watchdog"
    made.device.arm()
    made.hold(1.0, 1)
    made.time.sleep(2.1)
    made.hold(1.0, 1)
    assert made.events()[-1]["event"] == "watchdog"


@pytest.mark.parametrize(
    ("running", "held_v", "holds"), [(0, 1.0, True), (1, 1.0, False), (0, 2.0, False)]
)
def test_safe_is_a_stopped_stream_and_an_output_that_holds(
    driven, monkeypatch, running, held_v, holds
):
    """Each alone is not: a running stream writes over the output with its next scan."""
    wire = driven().device.wire
    wire._write = lambda data: None
    encoded = wire.setup.output.format.encode(held_v)
    answer = [stream.u32(running), encoded]
    monkeypatch.setattr(wire.session, "feedback", lambda *frames: answer)
    with nullcontext() if holds else pytest.raises(DeviceError):
        wire.confirm(1.0)


@pytest.mark.parametrize(("changes", "text"), [
    ({"profile": "labjack_t8"}, "LabJack T8 cannot stream: take kind: modbus_dac"),
    ({"output": "TDAC0"}, "output must be one that LabJack T7 can stream, DAC0, DAC1"),
    ({"reader": {"profile": "labjack_t4", "host": "10.0.0.9"}}, "reader must be omitted"),
])  # fmt: skip
def test_options_that_do_not_stream_are_refused(changes, text):
    with pytest.raises(InputError, match=text):
        ModbusStream(options(**changes))


@pytest.mark.parametrize(
    ("block", "messages"),
    [(1, 2), (58, 2), (59, 3), (580, 11)],
)
def test_a_block_costs_its_messages_and_one_that_waits(block, messages):
    profile = load_profile("labjack_t7")
    time = stream_time(profile, block)
    assert time.total_s == pytest.approx(messages * profile.turnaround_s)
    assert time.highest_rate_hz == pytest.approx(block / time.total_s)
    assert f"{block} samples in {messages} messages" in str(time)


STREAM_HZ = 1000.0
DAC0, AIN0 = 1000, 0
CAPACITY = 8000


def address_of(frame):
    return int.from_bytes(frame[1:3], "big")


class Scripted:
    """A device that answers as told: readings, scans left in it, and values that it still holds.

    Readings count up from 0. With ``starts`` False it never runs, and it scans at ``makes_hz``.
    """

    def __init__(self, *answers, starts=True, makes_hz=STREAM_HZ):
        self.answers, self.starts, self.makes_hz = list(answers), starts, makes_hz
        self.given, self.fed, self.calls = 0, 0, 0
        self.written = []

    def feedback(self, *frames):
        written = [(address_of(each), each[4:]) for each in frames if each[0]]
        self.written += [(address, data.hex()) for address, data in written]
        self.fed += sum(len(data) // 4 for at, data in written if at == stream.OUT_BUFFER_F32)
        if frames[0] != stream.read_frames()[0]:
            return [self.register(address_of(each)) for each in frames if not each[0]]
        self.calls += 1
        count, backlog, held = self.answers.pop(0)
        head = stream.DATA_HEAD.pack(count, 2 * backlog, 0, 0)
        readings = np.arange(self.given, self.given + count).astype(">u2").tobytes()
        self.given += count
        return head + readings, stream.u32(CAPACITY - held)

    def register(self, address):
        if address == stream.SCANRATE_HZ:
            return stream.f32(self.makes_hz)
        if address == stream.OUT_BUFFER_STATUS:
            return stream.u32(CAPACITY - self.fed)
        return stream.u32(int(self.starts))


@dataclass
class Scene:
    """A session with a scripted device, and the time that passes by its sleeps."""

    session: StreamSession
    device: Scripted
    slept_s: list[float]


@pytest.fixture
def scene():
    def of(*answers, queued=100, turnaround_s=0.001, **does):
        device, slept_s = Scripted(*answers, **does), []
        profile = load_profile("labjack_t7")
        session = StreamSession(
            device, profile.streaming, 0.1, turnaround_s, slept_s.append, lambda: sum(slept_s)
        )
        session.prepare(STREAM_HZ, [DAC0], [AIN0])
        session.feed(np.zeros((1, queued)))
        return Scene(session, device, slept_s)

    return of


def test_readings_are_waited_for_by_the_device_s_clock(scene):
    made = scene((10, 0, 90), (20, 5, 65), (5, 4, 61), (10, 0, 55))
    made.session.start()
    assert made.session.take(10).tolist() == list(range(10))
    assert made.slept_s == [0.01]
    assert made.session.take(20).tolist() == list(range(10, 30))
    assert made.slept_s == [0.01, 0.02]
    assert made.session.take(5).tolist() == list(range(30, 35))
    assert made.slept_s == [0.01, 0.02]  # all five were there
    assert made.session.take(10).tolist() == list(range(35, 45))
    assert made.slept_s[2:] == [0.006]  # four of ten were there
    assert made.device.calls == 4


def test_a_late_device_is_waited_for_and_a_standing_one_is_not(scene):
    late = scene(*[(0, 0, 100)] * 10, (10, 0, 90))
    late.session.start()
    assert late.session.take(10).size == 10
    at_last = scene(*[(0, 0, 100)] * 11, (10, 0, 90))
    at_last.session.start()
    assert at_last.session.take(10).size == 10
    assert sum(at_last.slept_s) > 0.11
    standing = scene(*[(0, 0, 100)] * 20)
    standing.session.start()
    with pytest.raises(DeviceError, match=r"0 of 10 readings"):
        standing.session.take(10)
    assert sum(standing.slept_s) == pytest.approx(0.12)


@pytest.mark.parametrize(
    ("held", "said"),
    [(3, None), (2, "only 2 values were left"), (0, "only 0 "), (-1, "empty for 1 sample")],
)
def test_fewer_values_than_the_margin_are_an_underrun(scene, held, said):
    made = scene((30 - held, 0, held), queued=30)
    made.session.start()
    if said is None:
        made.session.take(20)
        assert made.session.level_min == held
        return
    with pytest.raises(DeviceError, match=f"underrun: .*{said}.*, at sample 30"):
        made.session.take(20)


@pytest.mark.parametrize("off", [3, -3, 4, -4])
def test_as_many_values_as_ours_are_held_within_the_margin(scene, off):
    made = scene((10, 0, 90 + off))
    made.session.start()
    if abs(off) == 3:
        assert made.session.take(10).size == 10
        return
    with pytest.raises(DeviceError, match=f" {90 + off} .* 90"):
        made.session.take(10)


@pytest.mark.parametrize(("lost", "refused"), [(2, False), (3, True), (-2, False), (-3, True)])
def test_a_buffer_holds_what_was_queued_before_the_start(scene, lost, refused):
    made = scene()
    made.device.fed -= lost
    if not refused:
        made.session.start()
        assert made.session.running
        return
    with pytest.raises(DeviceError, match=f"^100 .* {100 - lost}$"):
        made.session.start()
    assert not made.session.running


def test_a_stream_that_does_not_run_is_an_error(scene):
    made = scene(starts=False)
    with pytest.raises(DeviceError, match="does not run"):
        made.session.start()
    assert not made.session.running


def test_readings_of_the_stream_before_are_forgotten(scene):
    made = scene((50, 0, 50), (10, 0, 90))
    made.session.start()
    made.session.take(10)
    made.session.stop()
    made.device.fed = 0
    made.session.prepare(STREAM_HZ, [DAC0], [AIN0])
    made.session.feed(np.zeros((1, 100)))
    made.session.start()
    assert made.session.take(10).tolist() == list(range(50, 60))


def test_a_rate_that_the_device_can_not_make_is_refused(scene):
    """100 ppm are 4 ms in 40 s."""
    scene(makes_hz=STREAM_HZ * (1.0 + 0.9e-4))
    scene(makes_hz=STREAM_HZ * (1.0 - 0.9e-4))
    for off in (1.2e-4, -1.2e-4):
        with pytest.raises(DeviceError, match="1000 Hz, the"):
            scene(makes_hz=STREAM_HZ * (1.0 + off))


def test_a_stream_is_set_up_by_its_registers(scene):
    """Stream-out 0 off, target, buffer of 16 KiB, its last value repeated, on; then the scan list.

    One input and the output, at 1 kHz, for ever, fetched by reading; nothing starts it.
    """
    one, none = "00000001", "00000000"
    assert scene(queued=0).device.written == [
        (4090, none),
        (4040, "000003e8"),
        (4050, "00004000"),
        (4060, one),
        (4090, one),
        (4002, "447a0000"),
        (4004, "00000002"),
        (4008, none),
        (4010, none),
        (4012, "00004000"),
        (4016, "00000010"),
        (4018, none),
        (4020, none),
        (4100, "00000000000012c0"),
    ]


def test_a_stream_is_started_and_stopped_by_one_register(scene):
    made = scene()
    made.device.written.clear()
    made.session.start()
    assert made.device.written == [(4990, "00000001")]
    made.session.stop()
    assert made.device.written[1:] == [(4990, "00000000")]
    made.device.starts = False
    made.session.stop()
    assert len(made.device.written) == 2


@pytest.mark.parametrize(("name", "form", "address", "constants"), [
    ("labjack_t7", "two_slopes", 0x3C4000, struct.pack(">4f", 3e-4, -3e-4, 33523.0, 0.0)),
    ("labjack_t4", "line", 0x3C4010, struct.pack(">2f", 4e-5, -0.1)),
])  # fmt: skip
def test_calibration_is_read_from_flash(name, form, address, constants):
    """The pointer is set first; of input 2, whose constants may be its own."""
    asked = []

    class Flash:
        def feedback(self, frame):
            asked.append((frame[0], address_of(frame), frame[3:] if frame[0] else frame[3]))
            return [constants]

    session = StreamSession(Flash(), load_profile(name).streaming, 0.1, 0.001)
    assert session.calibration(2) == stream.InputCalibration.decode(form, constants)
    pointer = (1, stream.FLASH_READ_POINTER, b"\2" + stream.u32(address))
    assert asked == [pointer, (0, stream.FLASH_READ, len(constants) // 2)]
