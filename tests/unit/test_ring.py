"""The ring between loop and recorder."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hilctl.ring import Field, Head, SampleRing

BLOCK, STATE = 3, 2


def make(tmp_path, slots=4):
    return SampleRing.create(tmp_path / "ring", slots=slots, block=BLOCK, state_size=STATE)


def push(ring, number, dropped=0):
    columns = np.full((5, BLOCK), float(number))
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
    assert batch.columns[1].tolist() == [[2.0] * BLOCK] * 5
    assert batch.states.tolist() == [[-1.0, -1.0], [-2.0, -2.0]]
    assert batch.flags.tolist() == [[1] * BLOCK, [2] * BLOCK]
    assert other.pop() is None


def test_full_ring_refuses_and_keeps_what_it_has(tmp_path):
    """A push into a full ring changes nothing and says so; a pop makes room again."""
    ring = make(tmp_path)
    other = SampleRing.attach(ring.path)
    assert [push(ring, n) for n in range(6)] == [True] * 4 + [False] * 2
    assert other.pop().heads[:, Head.FIRST_SAMPLE].tolist() == [0, 3, 6, 9]
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
    while (batch := other.pop()) is not None:
        taken += batch.heads[:, Head.DEADLINE_NS].tolist()
    assert taken == accepted


def test_damaged_slot_is_not_taken(tmp_path):
    """A slot whose number is not the expected one stops the consumer before it."""
    ring = make(tmp_path)
    other = SampleRing.attach(ring.path)
    for number in range(3):
        push(ring, number)
    ring._heads[1, Head.SEQUENCE] = 77
    assert other.pop().heads.shape[0] == 1
    assert other.pop() is None


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


def test_other_files_are_refused(tmp_path):
    """A file that is not a ring is not taken for one."""
    path = tmp_path / "zeros"
    path.write_bytes(bytes(100_000))
    with pytest.raises(ValueError, match="is not a hilctl ring"):
        SampleRing.attach(path)
