"""A loop that lives, and gives no sign of it."""

from hilctl.run.hang_watch import HangWatch
from hilctl.run.ring import SampleRing
from hilctl.run.shared_page import Field, Phase

LIMIT_S = 1.0


def watched(tmp_path):
    page = SampleRing.create(tmp_path / "ring", slots=4, block=1, state_size=1).page
    page.put(Field.PHASE, Phase.RUNNING)
    page.put(Field.LOOP_HEARTBEAT_NS, 1)
    return page, HangWatch(page, LIMIT_S)


def look(watch, times_s):
    return [watch.hangs(round(time_s * 1e9)) for time_s in times_s]


def test_silence_beyond_the_limit_is_a_hang(tmp_path):
    """A heartbeat that stands still for longer than the limit is told, and not before."""
    _, watch = watched(tmp_path)
    seen = look(watch, [0.1 * k for k in range(13)])
    assert seen == [False] * 11 + [True] * 2


def test_heartbeat_starts_the_time_again(tmp_path):
    """Any new sign of life will do."""
    page, watch = watched(tmp_path)
    assert not any(look(watch, [0.1 * k for k in range(10)]))
    page.put(Field.LOOP_HEARTBEAT_NS, 2)
    assert not any(look(watch, [0.9 + 0.1 * k for k in range(10)]))


def test_machine_that_stood_still_is_no_hang(tmp_path):
    """A long pause of both processes is not held against the loop."""
    _, watch = watched(tmp_path)
    assert not any(look(watch, [0.0, 0.1, 30.0, 30.02]))


def test_loop_that_does_not_run_yet_or_any_more_does_not_hang(tmp_path):
    """Opening and closing a device may take its time."""
    page, watch = watched(tmp_path)
    for phase in (Phase.STARTING, Phase.READY, Phase.ENDED, Phase.FAILED):
        page.put(Field.PHASE, phase)
        assert not any(look(watch, [0.5 * k for k in range(20)]))


def test_closing_a_device_has_more_time(tmp_path):
    """A device that is lost may use up its time-outs, but not for ever."""
    page, watch = watched(tmp_path)
    page.put(Field.PHASE, Phase.CLOSING)
    assert not any(look(watch, [float(k) for k in range(31)]))
    assert look(watch, [32.0]) == [True]
