"""From the ring to the recording beside the supervisor: in order, and once."""

import threading

import pytest

from hilctl.base.events import Event
from hilctl.base.samples import Head
from hilctl.loop.plan import Outcome
from hilctl.run import ring_recorder as module
from hilctl.run.ring import SampleRing
from hilctl.run.ring_recorder import RingRecorder
from hilctl.run.shared_page import Field

ENDED = Outcome("completed", "waveform completed", 8, "confirmed", 0)


class Recorder:
    """Keeps what it is given; a flush waits for ``disk``."""

    def __init__(self):
        self.firsts, self.events, self.finished, self.errors = [], [], None, []
        self.disk = threading.Event()
        self.disk.set()
        self.broken = self.refused = False

    @property
    def next_sample(self):
        return self.firsts[-1] + 1 if self.firsts else 0

    def batch(self, batch):
        if self.broken:
            raise ZeroDivisionError("a bug")
        self.firsts += batch.heads[:, Head.FIRST_SAMPLE].tolist()

    def event(self, event):
        self.events.append(event.code)

    def note_device(self):
        self.noted = len(self.firsts)

    def flush(self):
        assert self.disk.wait(30.0)
        return not self.refused

    def fail(self, why):
        self.errors.append(why)

    def finish(self, facts, ended_at):
        self.finished = (facts["reason"], ended_at)


@pytest.fixture
def ring(tmp_path):
    return SampleRing.create(tmp_path / "ring", slots=8, block=1, state_size=1)


@pytest.fixture
def recording(ring):
    """A recording of a ring; it is not started, so that a test says what it does when."""
    return RingRecorder(ring, Recorder(), flush_s=0.0)


def exchange(ring, count, *, answered=True):
    for _ in range(count):
        block = ring.claim()
        block.head[Head.FIRST_SAMPLE] = block.number
        ring.sending(block)
        if answered:
            ring.answered(block)


def test_room_is_given_back_once_the_file_has_what_stood_there(ring, recording):
    exchange(ring, 3)
    recording._work()
    assert recording.recorder.firsts == [0, 1, 2]
    assert ring.page.get(Field.TAIL) == 2  # an eighth of the ring stays for those who look on
    assert recording.newest.heads[-1, Head.FIRST_SAMPLE] == 2


def test_a_loop_that_is_never_waited_for_keeps_no_sample_from_the_file(ring, recording):
    """However busy the machine: there is another block each time that one has been recorded."""
    exchange(ring, 1)
    flushed = []
    batch, flush = recording.recorder.batch, recording.recorder.flush

    def slow(taken):
        batch(taken)
        exchange(ring, len(taken.heads))

    recording.recorder.batch = slow
    recording.recorder.flush = lambda: flushed.append(recording.recorder.next_sample) or flush()
    for _ in range(4):
        recording._work()
    assert flushed == sorted(set(flushed))
    assert len(flushed) == 4
    recording.recorder.batch = batch
    recording.end(ENDED, lost_loop=False)
    recording._finish()
    numbers = recording.recorder.firsts
    assert numbers == list(range(len(numbers)))
    assert ring.pop() is None


def test_what_the_disk_refuses_stays_in_the_ring(ring, recording, monkeypatch):
    """Written once all the same, and given room for as soon as the disk accepts it."""
    now_s = 100.0
    monkeypatch.setattr(module.time, "monotonic", lambda: now_s)
    recording._released_s = now_s
    recording.recorder.refused = True
    ring.page.push_event(Event(0, "info", "of_the_loop", ""))
    exchange(ring, 3)
    recording._work()
    now_s = 103.0
    exchange(ring, 2)
    recording._work()
    assert ring.page.get(Field.TAIL) == ring.page.get(Field.EVENT_TAIL) == 0
    assert recording.stalled_s() == 3.0
    recording.recorder.refused = False
    recording._work()
    assert recording.recorder.firsts == [0, 1, 2, 3, 4]
    assert recording.recorder.events == ["of_the_loop"]
    assert (ring.page.get(Field.TAIL), ring.page.get(Field.EVENT_TAIL)) == (4, 1)
    assert recording.stalled_s() == 0.0


def test_events_of_both_sides_come_after_the_samples(ring, recording):
    exchange(ring, 1)
    ring.page.push_event(Event(0, "info", "of_the_loop", ""))
    recording.record_event(Event(0, "warning", "of_the_supervisor", ""))
    recording._work()
    assert recording.recorder.events == ["of_the_loop", "of_the_supervisor"]


def test_an_event_of_the_loop_never_comes_before_its_samples(ring, recording, monkeypatch):
    """A block and its event that come while the samples are taken wait for the next time."""
    batches, recorder, went_on = ring.batches, recording.recorder, []

    def batches_and_go_on():
        yield from batches()
        if not went_on:
            went_on.append(True)
            exchange(ring, 1)
            ring.page.push_event(Event(0, "error", "stroke", ""))

    monkeypatch.setattr(ring, "batches", batches_and_go_on)
    recording._drain()
    assert (recorder.firsts, recorder.events) == ([], [])
    recording._drain()
    assert (recorder.firsts[:1], recorder.events) == ([0], ["stroke"])


def test_what_a_dead_loop_had_sent_is_recorded_as_not_answered(ring, recording):
    """And the samples behind a damaged block come out too."""
    exchange(ring, 4)
    exchange(ring, 2, answered=False)
    ring._area.heads[1, Head.SEQUENCE] = 77
    recording.end(Outcome("fault", "it died", 0, "confirmed", 0), lost_loop=True)
    recording._finish()
    assert recording.recorder.firsts == [0, 2, 3, 4, 5]
    assert recording.recorder.finished == ("it died", 6)


def test_a_loop_that_ended_by_itself_says_where(ring, recording):
    exchange(ring, 2)
    recording.end(ENDED, lost_loop=False)
    recording._finish()
    assert recording.recorder.finished == ("waveform completed", 8)


def test_whatever_goes_wrong_in_it_is_said_and_the_end_comes_all_the_same(ring, recording):
    exchange(ring, 2)
    recording.recorder.broken = True
    recording._guarded(recording._work)
    assert recording.recorder.errors == ["ZeroDivisionError: a bug"]
    recording.recorder.broken = False
    recording.end(ENDED, lost_loop=False)
    recording.start()
    recording._thread.join(30.0)
    assert recording.finished
    assert recording.recorder.finished == ("waveform completed", 8)


def test_the_device_is_told_of_the_run_before_all_else(ring, recording):
    """A run that is killed must not leave the device to the one before it."""
    exchange(ring, 2)
    recording.end(ENDED, lost_loop=False)
    recording.start()
    recording._thread.join(30.0)
    assert (recording.recorder.noted, recording.recorder.firsts) == (0, [0, 1])


def test_nobody_waits_for_a_disk_that_stands_still(ring, recording, monkeypatch):
    """The ring keeps what comes; how long it has been without room is known to the supervisor."""
    now_s = 100.0
    monkeypatch.setattr(module.time, "monotonic", lambda: now_s)
    recording.recorder.disk.clear()
    exchange(ring, 2)
    recording.start()
    recording.record_event(Event(0, "info", "x", ""))
    recording.end(ENDED, lost_loop=False)
    assert not recording.finished
    now_s = 107.0
    assert recording.stalled_s() == 7.0
    assert ring.page.get(Field.TAIL) == 0
    recording.recorder.disk.set()
    recording._thread.join(30.0)
    assert recording.recorder.finished == ("waveform completed", 8)


def test_marks_are_taken_as_long_as_they_will_be_in_the_file(recording):
    """Not of a run that is over, on a disk that fails, or where too many wait for it."""
    recording.recorder.error = ""
    assert recording.takes_marks
    for _ in range(64):
        recording.record_event(Event(0, "info", "mark", "tapped"))
    assert not recording.takes_marks
    recording._drain()
    assert recording.takes_marks
    recording.recorder.error = "no room"
    assert not recording.takes_marks
    recording.recorder.error = ""
    recording.end(ENDED, lost_loop=False)
    assert not recording.takes_marks
