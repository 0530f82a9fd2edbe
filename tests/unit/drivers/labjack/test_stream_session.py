"""A stream's session: counts of what is queued, played and fetched, and what they must agree on."""

import struct
from dataclasses import dataclass

import numpy as np
import pytest

from hilctl.base.errors import DeviceError
from hilctl_drivers.labjack import stream
from hilctl_drivers.labjack.stream_session import StreamSession
from hilctl_drivers.modbus.pdu import WriteFrame
from hilctl_drivers.profile import load_profile

RATE_HZ = 1000.0
DAC0, AIN0 = 1000, 0
CAPACITY = 8000


class Scripted:
    """A device that answers as told: readings, scans left in it, and values that it still holds.

    Readings count up from 0. With ``starts`` False it never runs, and it scans at ``makes_hz``.
    """

    def __init__(self, *answers, starts=True, makes_hz=RATE_HZ):
        self.answers, self.starts, self.makes_hz = list(answers), starts, makes_hz
        self.given, self.fed, self.calls = 0, 0, 0
        self.written = []

    def read(self, address, words):
        if address == stream.SCANRATE_HZ:
            return stream.f32(self.makes_hz)
        if address == stream.OUT_BUFFER_STATUS:
            return stream.u32(CAPACITY - self.fed)
        return stream.u32(int(self.starts))

    def call(self, frames):
        written = [each for each in frames if isinstance(each, WriteFrame)]
        self.written += [(each.address, each.data.hex()) for each in written]
        self.fed += sum(len(w.data) // 4 for w in written if w.address == stream.OUT_BUFFER_F32)
        if frames[0] is not stream.READ_FRAMES[0]:
            return []
        self.calls += 1
        count, backlog, held = self.answers.pop(0)
        head = stream.DATA_HEAD.pack(count, 2 * backlog, 0, 0)
        readings = np.arange(self.given, self.given + count).astype(">u2").tobytes()
        self.given += count
        return head + readings, stream.u32(CAPACITY - held)


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
        session.prepare(RATE_HZ, DAC0, AIN0)
        session.feed(np.zeros(queued))
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


def test_readings_beyond_those_asked_for_are_kept(scene):
    made = scene((12, 0, 88), (12, 0, 76))
    made.session.start()
    assert made.session.take(10).tolist() == list(range(10))
    assert made.session.take(2).tolist() == [10, 11]
    assert made.device.calls == 1
    assert made.session.take(7).tolist() == list(range(12, 19))
    assert made.slept_s == [0.01, 0.007]


def test_more_than_one_answer_holds_is_fetched_in_parts(scene):
    most = stream.SAMPLES_MAX
    made = scene((most, 0, 280), (30, 0, 250), queued=most + 280)
    made.session.start()
    assert made.session.take(most + 30).size == most + 30
    assert made.slept_s == [most / RATE_HZ, 0.03]


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


def test_the_margin_is_rounded_up(scene):
    assert scene(turnaround_s=0.0011).session.margin == 4


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
    made.session.prepare(RATE_HZ, DAC0, AIN0)
    made.session.feed(np.zeros(100))
    made.session.start()
    assert made.session.take(10).tolist() == list(range(50, 60))


def test_readings_come_with_values_that_are_fed_while_it_runs(scene):
    made = scene((60, 0, 40), (0, 0, 40 + 58))
    made.session.start()
    made.session.feed(np.zeros(stream.VALUES_MAX + 2))
    assert made.device.calls == 2
    assert made.session.level_min == 40
    assert made.session.take(60).size == 60
    assert made.device.calls == 2


def test_a_rate_that_the_device_can_not_make_is_refused(scene):
    """100 ppm are 4 ms in 40 s."""
    scene(makes_hz=RATE_HZ * (1.0 + 0.9e-4))
    scene(makes_hz=RATE_HZ * (1.0 - 0.9e-4))
    for off in (1.2e-4, -1.2e-4):
        with pytest.raises(DeviceError, match="1000 Hz, the"):
            scene(makes_hz=RATE_HZ * (1.0 + off))


def test_a_stream_is_set_up_by_its_registers(scene):
    """Stream-out 0 off, target, buffer of 16 KiB, its last value repeated, on; then the scan list.

    One input and the output, at 1 kHz, for ever, fetched by reading; nothing starts it.
    """
    one, none = "00000001", "00000000"
    assert scene(queued=0).device.written == [
        (4090, none), (4040, "000003e8"), (4050, "00004000"), (4060, one), (4090, one),
        (4002, "447a0000"), (4004, "00000002"), (4008, none), (4010, none), (4012, "00004000"),
        (4016, "00000010"), (4018, none), (4020, none), (4100, "00000000" "000012c0"),
    ]  # fmt: skip


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


@pytest.mark.parametrize(
    ("name", "form", "address", "constants"),
    [
        ("labjack_t7", "two_slopes", 0x3C4000, struct.pack(">4f", 3e-4, -3e-4, 33523.0, 0.0)),
        ("labjack_t4", "line", 0x3C4010, struct.pack(">2f", 4e-5, -0.1)),
    ],
)
def test_calibration_is_read_from_flash(name, form, address, constants):
    """The pointer is set first; of input 2, whose constants may be its own."""
    asked = []

    class Flash:
        def call(self, frames):
            asked.extend((each.address, each.data) for each in frames)

        def read(self, address, words):
            asked.append((address, words))
            return constants

    session = StreamSession(Flash(), load_profile(name).streaming, 0.1, 0.001)
    assert session.calibration(2) == stream.InputCalibration.decode(form, constants)
    pointer = (stream.FLASH_READ_POINTER, stream.u32(address))
    assert asked == [pointer, (stream.FLASH_READ, len(constants) // 2)]
