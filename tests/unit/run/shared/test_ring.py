"""The ring between loop and recorder."""

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from hilctl.base.samples import ANSWERS, COLUMNS, LAST_SAMPLE, LONGEST_NS, BlockHeader, Flag
from hilctl.run.shared import ring as module
from hilctl.run.shared.ring import SampleRing
from hilctl.run.shared.shared_page import PageField, PageSlot

BLOCK, STATE = 3, 2


def make(tmp_path, slots=4):
    return SampleRing.create(tmp_path / "ring", slots=slots, block=BLOCK, state_size=STATE, aux=2)


def born(ring, number, *, due=True):
    """Fill a block in its slot and send it."""
    block = ring.claim(due=due)
    block.head[BlockHeader.FIRST_SAMPLE], block.head[BlockHeader.SAMPLES] = number * BLOCK, BLOCK
    block.head[BlockHeader.DEADLINE_NS] = number
    block.state[:] = -number
    for row in (block.reference, block.wanted, block.command, block.input_um):
        row[:] = number
    block.columns[ANSWERS] = block.aux[:] = number
    block.flags[:] = number
    ring.sending(block)
    ring.exchanging(block)
    return block


def push(ring, number):
    """Fill, send and answer a block; return whether it has a slot."""
    return ring.answered(born(ring, number))


def test_blocks_are_read_as_written(tmp_path):
    ring = make(tmp_path)
    other = SampleRing(ring.path)
    assert push(ring, 1)
    assert push(ring, 2)
    batch = other.pop()
    assert batch.heads[:, BlockHeader.FIRST_SAMPLE].tolist() == [3, 6]
    assert batch.columns[1].tolist() == [[2.0] * BLOCK] * len(COLUMNS)
    assert batch.states.tolist() == [[-1.0, -1.0], [-2.0, -2.0]]
    assert batch.flags.tolist() == [[1] * BLOCK, [2] * BLOCK]
    assert batch.aux.tolist() == [[1.0, 1.0], [2.0, 2.0]]
    assert other.pop() is None


def test_full_ring_refuses_and_keeps_what_it_has(tmp_path):
    ring = make(tmp_path)
    other = SampleRing(ring.path)
    assert [push(ring, n) for n in range(6)] == [True] * 4 + [False] * 2
    assert other.pop().heads[:, BlockHeader.FIRST_SAMPLE].tolist() == [0, 3, 6, 9]
    assert not push(ring, 9)
    other.release()
    assert push(ring, 9)
    assert other.page.losses() == (3 * BLOCK, 0)


def test_many_blocks_are_read_in_batches(tmp_path, monkeypatch):
    monkeypatch.setattr(module, "_BATCH_SAMPLES", 2 * BLOCK)
    ring = make(tmp_path, slots=7)
    other = SampleRing(ring.path)
    for number in range(3):
        push(ring, number)
    assert [batch.heads.shape[0] for batch in other.batches()] == [2, 1]
    other.release()
    for number in range(3, 9):
        push(ring, number)
    sizes, taken = [], []
    for batch in other.batches():
        sizes.append(batch.heads.shape[0])
        taken += (batch.heads[:, BlockHeader.FIRST_SAMPLE] // BLOCK).tolist()
        if len(sizes) == 1:
            push(ring, 9)
    assert (sizes, taken) == ([2, 2, 2], [*range(3, 9)])
    assert [batch.heads.shape[0] for batch in other.batches()] == [1]
    assert not [*other.batches()]


@settings(max_examples=50)
@given(st.lists(st.booleans(), max_size=200))
def test_any_order_of_pushes_and_pops(tmp_path_factory, steps):
    ring = make(tmp_path_factory.mktemp("ring"), slots=3)
    other = SampleRing(ring.path)
    accepted, taken = [], []
    for number, is_push in enumerate(steps):
        if is_push:
            if push(ring, number):
                accepted.append(number)
        elif (batch := other.pop()) is not None:
            taken += batch.heads[:, BlockHeader.DEADLINE_NS].tolist()
            other.release()
    while (batch := other.pop()) is not None:
        taken += batch.heads[:, BlockHeader.DEADLINE_NS].tolist()
    assert taken == accepted


def test_damaged_slot_is_skipped(tmp_path):
    ring = make(tmp_path)
    other = SampleRing(ring.path)
    for number in range(3):
        push(ring, number)
    ring._area.heads[1, BlockHeader.SEQUENCE] = 77
    assert other.pop().heads.shape[0] == 1
    assert other.pop() is None
    assert other.skip_damaged() == 1
    assert other.pop().heads[:, BlockHeader.FIRST_SAMPLE].tolist() == [6]
    assert other.skip_damaged() == 0


@pytest.mark.parametrize(("field", "value"), [
    (BlockHeader.FIRST_SAMPLE, LAST_SAMPLE),
    (BlockHeader.FIRST_SAMPLE, -1),
    (BlockHeader.DROPPED_BEFORE, -1),
    (BlockHeader.DROPPED_BEFORE, 4),
    (BlockHeader.DEADLINE_NS, LONGEST_NS + 1),
    (BlockHeader.LATE_NS, -LONGEST_NS - 1),
])  # fmt: skip
def test_slot_with_impossible_numbers_is_skipped(tmp_path, field, value):
    """Once recorded, it would make the rest unreadable."""
    ring = make(tmp_path)
    for number in range(3):
        push(ring, number)
    ring._area.heads[1, field] = value
    assert ring.pop().heads.shape[0] == 1
    assert ring.skip_damaged() == 1
    assert ring.pop().heads[:, BlockHeader.FIRST_SAMPLE].tolist() == [6]


def test_unreleased_blocks_are_read_by_the_next_consumer(tmp_path):
    ring = make(tmp_path)
    first = SampleRing(ring.path)
    push(ring, 0)
    first.pop()
    first.release()
    push(ring, 1)
    first.pop()
    push(ring, 2)
    second = SampleRing(ring.path)
    assert second.pop().heads[:, BlockHeader.FIRST_SAMPLE].tolist() == [3, 6]


def test_sent_blocks_remain_after_the_loop_dies(tmp_path):
    ring = SampleRing.create(
        tmp_path / "ring", slots=4, block=BLOCK, state_size=STATE, latency_blocks=2
    )
    other = SampleRing(ring.path)
    assert other.unanswered(0) is None
    assert push(ring, 0)
    for number in (1, 2, 3):
        born(ring, number).flags[:] = Flag.SLEW_LIMITED
    assert other.pop().heads[:, BlockHeader.FIRST_SAMPLE].tolist() == [0]
    batch = other.unanswered(5)
    assert batch.heads[:, BlockHeader.FIRST_SAMPLE].tolist() == [6, 9]
    assert batch.heads[:, BlockHeader.DROPPED_BEFORE].tolist() == [1, 0]
    assert np.isnan(batch.columns[:, 3:5]).all()
    assert np.isnan(batch.aux).all()
    assert (batch.columns[:, 5] == batch.columns[:, 2]).all()
    assert (batch.columns[:, 2] == [[2.0] * BLOCK, [3.0] * BLOCK]).all()
    assert (batch.flags & Flag.UNANSWERED).all()
    assert (batch.flags & Flag.SLEW_LIMITED).all()
    assert other.unanswered(12) is None


def test_block_uses_a_spare_slot_if_the_ring_is_full(tmp_path):
    ring = SampleRing.create(
        tmp_path / "ring", slots=2, block=BLOCK, state_size=STATE, latency_blocks=1
    )
    other = SampleRing(ring.path)
    kept = [born(ring, 1), born(ring, 2)]
    spare = [born(ring, 3), born(ring, 4)]
    assert [block.command[0] for block in (*kept, *spare)] == [1.0, 2.0, 3.0, 4.0]
    assert [ring.answered(block) for block in (*kept, *spare)] == [True, True, False, False]
    assert other.pop().columns[:, 2, 0].tolist() == [1.0, 2.0]
    assert other.page.get(PageField.ENDED_AT) == 5 * BLOCK
    assert other.unanswered(0) is None


def test_unpublished_block_is_never_read(tmp_path):
    ring = make(tmp_path)
    other = SampleRing(ring.path)
    assert not ring.answered(born(ring, 7, due=False))
    assert push(ring, 1)
    assert other.pop().heads[:, BlockHeader.FIRST_SAMPLE].tolist() == [3]


@settings(max_examples=60)
@given(st.binary(min_size=1, max_size=64), st.integers(0, 60_000))
@example(b"\x00\x00\x00\x00\x00\x00\x80\x00\x00\x01", 57)  # numbers 2**63 from each other
@example(b"\xff" * 7 + b"\x7f", 56)
def test_reading_a_damaged_ring_raises_nothing(tmp_path_factory, garbage, at):
    ring = make(tmp_path_factory.mktemp("ring"), slots=3)
    other = SampleRing(ring.path)
    for number in range(3):
        push(ring, number)
    at = min(at, len(ring._map) - len(garbage))
    ring._map[at : at + len(garbage)] = garbage
    for _ in range(10):
        other.pop()
        other.page.pop_events()
        other.skip_damaged()
        other.release()
    other.unanswered(0)
    other.look(0)
    other.page.read_text(PageSlot.ERROR)
    other.page.outcome()


def test_other_files_are_refused(tmp_path):
    path = tmp_path / "zeros"
    path.write_bytes(bytes(100_000))
    with pytest.raises(ValueError, match="hilctl ring"):
        SampleRing(path)


@pytest.mark.parametrize(
    "field", [PageField.SLOTS, PageField.BLOCK, PageField.STATE_SIZE, PageField.SPARE]
)
@pytest.mark.parametrize("value", [-1, 0, 2**40])
def test_impossible_sizes_are_refused(tmp_path, field, value):
    ring = make(tmp_path)
    ring.page.put(field, value)
    with pytest.raises(ValueError, match=r"damaged|shorter"):
        SampleRing(ring.path)


def test_claimed_slots_are_cleared(tmp_path):
    ring = make(tmp_path, slots=3)
    other = SampleRing(ring.path)
    for number in range(20):
        block = ring.claim()
        assert not block.flags.any()
        assert np.isnan(block.displacement_um).all()
        assert np.isnan(block.measured).all()
        assert np.isnan(block.aux).all()
        assert push(ring, number + 1)
        if number % 3 != 1:
            other.pop()
            other.release()


def test_observer_reads_blocks_without_consuming_them(tmp_path):
    ring = make(tmp_path, slots=4)
    consumer, seen = SampleRing(ring.path), SampleRing(ring.path, look_only=True)
    for number in range(3):
        push(ring, number)
    batch, after = seen.look(1)
    assert (batch.heads[:, BlockHeader.FIRST_SAMPLE].tolist(), after) == ([3, 6], 3)
    consumer.pop()
    consumer.release(keep=1)
    batch, after = seen.look(0)
    assert (batch.columns[:, 0, 0].tolist(), after) == ([2.0], 3)
    assert np.isfinite(batch.columns).all()
    push(ring, 3)
    assert consumer.pop().heads[:, BlockHeader.FIRST_SAMPLE].tolist() == [9]
    assert seen.look(7)[1] == 7
    with pytest.raises(ValueError, match="read-only"):
        seen.page.put(PageField.STOP, 1)


def test_block_overwritten_during_the_copy_is_skipped(tmp_path):
    ring = make(tmp_path, slots=4)
    for number in range(4):
        push(ring, number)
    seen = SampleRing(ring.path, look_only=True)
    rows = seen._area.rows

    class Area:
        def rows(self, chosen):
            ring.page.put(PageField.CLEANED, 2)
            return rows(chosen)

    seen._area = Area()
    ring._area.heads[3, BlockHeader.SEQUENCE] = 77
    batch, after = seen.look(0)
    assert (batch.heads[:, BlockHeader.FIRST_SAMPLE].tolist(), after) == ([6], 4)


def test_cursors_are_published_after_their_data(tmp_path, monkeypatch):
    ring, seen = make(tmp_path), []

    def publishing(page):
        publish = page.publishes

        def spied(numbers, field, value):
            heads, flags = ring._area.heads[:, BlockHeader.SEQUENCE], ring._area.flags[:, 0]
            seen.append(
                (PageField(field), value, heads.max().item(), heads.min().item(), flags.max())
            )
            publish(numbers, field, value)

        return spied

    monkeypatch.setattr(ring, "_publish", publishing(ring.page))
    monkeypatch.setattr(ring.page, "publishes", publishing(ring.page))
    assert push(ring, 3)
    assert ring.pop() is not None
    ring.release()
    assert seen == [
        (PageField.SENT, 1, 0, -1, 3),
        (PageField.HEAD, 1, 1, 0, 3),
        (PageField.EVENT_TAIL, 0, 1, 0, 3),
        (PageField.CLEANED, 1, 1, 0, 3),
        (PageField.TAIL, 1, 1, 0, 0),
    ]


def test_a_block_whose_exchange_has_not_begun_is_no_last_command(tmp_path):
    """The loop was killed in the exchange of another axis; the block is recovered nevertheless."""
    ring = make(tmp_path)
    ring.page.put_float(PageField.OUTPUT_AT_START, 0.5)
    assert ring.last_command() == 0.5
    push(ring, 0)
    block = ring.claim()
    block.head[BlockHeader.FIRST_SAMPLE], block.command[:] = BLOCK, 1.0
    ring.sending(block)
    assert ring.last_command() == 0.0
    ring.exchanging(block)
    assert ring.last_command() == 1.0
    assert ring.page.get(PageField.UNANSWERED) == 1
    assert ring.unanswered(BLOCK) is not None
