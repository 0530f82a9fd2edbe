"""The ring between loop and recorder."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hilctl.base.events import LoopEvent
from hilctl.base.samples import Flag, Head
from hilctl.run.ring import SampleRing
from hilctl.run.shared_page import Field

BLOCK, STATE = 3, 2


def make(tmp_path, slots=4):
    return SampleRing.create(tmp_path / "ring", slots=slots, block=BLOCK, state_size=STATE)


def push(ring, number, dropped=0):
    columns = np.full((6, BLOCK), float(number))
    head = (number * BLOCK, BLOCK, dropped, number, number, number)
    return ring.push(head, np.full(STATE, -number), columns, np.full(BLOCK, number, np.uint32))


def test_blocks_come_out_as_they_went_in(tmp_path):
    """Heads, states, columns and flags arrive whole and in order in the other process's view."""
    ring = make(tmp_path)
    other = SampleRing.attach(ring.path)
    assert push(ring, 1)
    assert push(ring, 2)
    batch = other.pop()
    assert batch.heads[:, Head.FIRST_SAMPLE].tolist() == [3, 6]
    assert batch.columns[1].tolist() == [[2.0] * BLOCK] * 6
    assert batch.states.tolist() == [[-1.0, -1.0], [-2.0, -2.0]]
    assert batch.flags.tolist() == [[1] * BLOCK, [2] * BLOCK]
    assert other.pop() is None


def test_full_ring_refuses_and_keeps_what_it_has(tmp_path):
    """A push into a full ring changes nothing and says so; a release makes room again."""
    ring = make(tmp_path)
    other = SampleRing.attach(ring.path)
    assert [push(ring, n) for n in range(6)] == [True] * 4 + [False] * 2
    assert other.pop().heads[:, Head.FIRST_SAMPLE].tolist() == [0, 3, 6, 9]
    assert not push(ring, 9)
    other.release()
    assert push(ring, 9)


@settings(max_examples=50)
@given(st.lists(st.booleans(), max_size=200))
def test_any_order_of_pushes_and_pops(tmp_path_factory, steps):
    """Whatever the order, blocks come out once each, in order, or were refused."""
    ring = make(tmp_path_factory.mktemp("ring"), slots=3)
    other = SampleRing.attach(ring.path)
    accepted, taken = [], []
    for number, is_push in enumerate(steps):
        if is_push:
            if push(ring, number):
                accepted.append(number)
        elif (batch := other.pop()) is not None:
            taken += batch.heads[:, Head.DEADLINE_NS].tolist()
            other.release()
    while (batch := other.pop()) is not None:
        taken += batch.heads[:, Head.DEADLINE_NS].tolist()
    assert taken == accepted


def test_damaged_slot_is_not_taken(tmp_path):
    """A slot whose number is not the expected one stops the consumer before it."""
    ring = make(tmp_path)
    other = SampleRing.attach(ring.path)
    for number in range(3):
        push(ring, number)
    ring._slots.heads[1, Head.SEQUENCE] = 77
    assert other.pop().heads.shape[0] == 1
    assert other.pop() is None
    assert other.skip_damaged() == 1
    assert other.pop().heads[:, Head.FIRST_SAMPLE].tolist() == [6]
    assert other.skip_damaged() == 0


def test_control_page_and_text_are_shared(tmp_path):
    """Numbers and texts written on one side are read on the other; long texts are cut."""
    ring = make(tmp_path)
    other = SampleRing.attach(ring.path)
    other.put(Field.STOP, 3)
    assert ring.get(Field.STOP) == 3
    ring.write_text("öffnen")
    assert other.read_text() == "öffnen"
    ring.write_text("µ" * 10_000)
    assert set(other.read_text()) == {"µ"}


def test_what_was_not_released_is_there_for_the_next_consumer(tmp_path):
    """A consumer that dies with blocks in its hands leaves them in the ring."""
    ring = make(tmp_path)
    first = SampleRing.attach(ring.path)
    push(ring, 0)
    first.pop()
    first.release()
    push(ring, 1)
    first.pop()
    push(ring, 2)
    second = SampleRing.attach(ring.path)
    assert second.pop().heads[:, Head.FIRST_SAMPLE].tolist() == [3, 6]


def sent(ring, row, sequence, first):
    ring.sent.heads[row] = (sequence, first, BLOCK, 0, 0, 0, 0)
    ring.sent.columns[row] = float(first)
    ring.sent.flags[row] = Flag.SLEW_LIMITED


def test_blocks_that_were_sent_outlive_their_loop(tmp_path):
    """They come in order, without those already taken, flagged, with the gap before them."""
    ring = SampleRing.create(tmp_path / "ring", slots=4, block=BLOCK, state_size=STATE, in_flight=3)
    other = SampleRing.attach(ring.path)
    assert other.unanswered(0) is None
    sent(ring, 0, 4, 9)
    sent(ring, 1, 2, 3)
    sent(ring, 2, 3, 6)
    batch = other.unanswered(5)
    assert batch.heads[:, Head.FIRST_SAMPLE].tolist() == [6, 9]
    assert batch.heads[:, Head.DROPPED_BEFORE].tolist() == [1, 0]
    assert np.isnan(batch.columns[:, 3:5]).all()
    assert (batch.columns[:, 5] == batch.columns[:, 2]).all()
    assert (batch.columns[:, 2] == [[6.0] * BLOCK, [9.0] * BLOCK]).all()
    assert (batch.flags & Flag.UNANSWERED).all()
    assert (batch.flags & Flag.SLEW_LIMITED).all()
    assert other.unanswered(12) is None


def test_events_come_once_and_are_cut_to_what_fits(tmp_path):
    """Events keep their order; too many are counted as lost, and long ones are shortened."""
    ring = make(tmp_path)
    other = SampleRing.attach(ring.path)
    for sample in range(40):
        ring.push_event(LoopEvent(sample, "error", "test", "ü" * 1000))
    events = other.pop_events()
    assert [event.sample for event in events] == list(range(32))
    assert set(events[0].text) == {"ü"}
    assert ring.get(Field.EVENTS_LOST) == 8
    ring.push_event(LoopEvent(41, "info", "test", "no room yet"))
    other.release()
    ring.push_event(LoopEvent(42, "info", "test", "room"))
    assert [event.sample for event in other.pop_events()] == [42]


@settings(max_examples=60)
@given(st.binary(min_size=1, max_size=64), st.integers(0, 60_000))
def test_damaged_ring_is_survived(tmp_path_factory, garbage, at):
    """Whatever stands in the memory, the consumer comes to an end, and raises nothing."""
    ring = make(tmp_path_factory.mktemp("ring"), slots=3)
    other = SampleRing.attach(ring.path)
    for number in range(3):
        push(ring, number)
    at = min(at, len(ring._map) - len(garbage))
    ring._map[at : at + len(garbage)] = garbage
    for _ in range(10):
        other.pop()
        other.pop_events()
        other.skip_damaged()
        other.release()
    other.unanswered(0)
    other.read_text()


def test_other_files_are_refused(tmp_path):
    """A file that is not a ring is not taken for one."""
    path = tmp_path / "zeros"
    path.write_bytes(bytes(100_000))
    with pytest.raises(ValueError, match="is not a hilctl ring"):
        SampleRing.attach(path)
