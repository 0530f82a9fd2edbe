"""A stream's session: counts of what is queued, played and fetched, and what they must agree on."""

import numpy as np
import pytest

from hilctl.base.errors import DeviceError
from hilctl_drivers.labjack.frames import ModbusFeedback
from hilctl_drivers.labjack.session import StreamSession
from hilctl_drivers.profile import load_profile
from tests.fakes import InProcess

RATE_HZ = 1000.0
DAC0, AIN0 = 1000, 0


@pytest.fixture
def rig():
    """An emulated T7 in the test's own time, and a session that is prepared."""
    made = InProcess.of("labjack_t7", message_s=0.0005)
    made.link.open()
    profile = load_profile("labjack_t7")
    session = StreamSession(
        ModbusFeedback(made.link, 1), profile.streaming, 0.1, 0.001, made.time.sleep, made.time
    )
    session.stop()
    session.prepare(RATE_HZ, DAC0, AIN0)
    yield made, session
    made.log.close()


def test_values_come_back_as_readings_of_the_same_scans(rig):
    _, session = rig
    session.feed(np.full(200, 2.0))
    session.start()
    first, then = session.take(50), session.take(50)
    assert (first.size, then.size) == (50, 50)
    assert first.dtype == np.uint16
    assert session.level_min < 200


def test_a_stream_that_runs_dry_is_an_error(rig):
    """Each value is put out in its own scan or not at all."""
    made, session = rig
    session.feed(np.full(20, 2.0))
    session.start()
    made.time.sleep(0.1)
    with pytest.raises(DeviceError, match="underrun: the device had nothing new"):
        session.take(10)


def test_the_margin_is_what_a_message_takes(rig):
    """One millisecond is one scan at 1 kHz, and two more."""
    _, session = rig
    assert session.margin == 3
    assert session.capacity > 0


def test_values_that_were_lost_on_the_way_are_noticed_before_the_start(rig):
    _, session = rig
    session.feed(np.full(50, 2.0))
    session._queued += 10
    with pytest.raises(DeviceError, match="60 values were queued, the device holds 50"):
        session.start()


def test_a_clock_that_stands_ends_the_wait(rig):
    """After the time-out, with what had come until then."""
    made, session = rig
    session.feed(np.full(500, 2.0))
    session.start()
    session.stop()
    with pytest.raises(DeviceError):
        session.take(400)
    assert made.time() < 60.0


def test_values_can_be_queued_for_another_start_after_a_stop(rig):
    """No readings are fetched from a stream that stands."""
    _, session = rig
    session.feed(np.full(200, 2.0))
    session.start()
    session.stop()
    assert not session.running
    session.prepare(RATE_HZ, DAC0, AIN0)
    session.feed(np.full(30, 2.0))
    session.start()
    assert session.take(10).size == 10


@pytest.mark.parametrize("more", [-20, 20])
def test_count_of_the_device_must_be_ours(rig, more):
    """Whether it left values out or repeated some."""
    made, session = rig
    session.feed(np.full(200, 2.0))
    session.start()
    made.device.overlay.fifo.level += more
    with pytest.raises(DeviceError, match="by its scans it must be"):
        session.take(10)
