"""Columns of samples and ticks, gathered from blocks one by one or from many chunks at once."""

import io

import numpy as np
import pytest

from hilctl.kernels import packed
from hilctl.recording.blocks import Blocks, Table, TickTable
from hilctl.recording.chunks import Messages
from hilctl.recording.salvage import Salvage
from hilctl.recording.wire import sample_block, tick_block

EVERY = (0, 2**40)


def messages_of(make, *batches):
    """Blocks and ticks of batches, as messages of one chunk, and the messages."""
    stream = io.BytesIO()
    make.write(stream, batches)
    records = [
        each for each in Salvage(io.BytesIO(stream.getvalue())).records()
        if getattr(each, "channel_id", None) in {1, 2}
    ]  # fmt: skip
    from mcap.data_stream import RecordBuilder

    builder = RecordBuilder()
    for each in records:
        each.write(builder)
    return Messages.of(np.frombuffer(builder.end(), np.uint8).copy()), records


def test_many_small_blocks_take_no_array_each():
    """Views of messages are joined as they come."""
    table = Table()
    for number in range(2000):
        table.add({"a": np.array([number])} | ({"b": np.array([number])} if number % 7 else {}))
        assert len(table._loose.get("a", [])) < 512
    assert table.column("a", np.int64).tolist() == list(range(2000))
    assert table.column("b", np.int64).tolist() == [n for n in range(2000) if n % 7]
    assert table.column("a", np.int64).size == 0


@pytest.mark.parametrize("bounds", [EVERY, (250, 300), (5000, 6000)])
def test_blocks_of_a_chunk_are_those_one_by_one(make, bounds):
    """With the columns of the one before them, gaps and what stands at their end."""
    batches = [make.batch(300 * k, 4, dropped=100 if k else 0, seed=k) for k in range(4)]
    messages, records = messages_of(make, *batches)
    decoded = [sample_block(each.data) for each in records if each.channel_id == 1]
    one, all_ = Blocks(), Blocks()
    all_.add(decoded[0])
    rows = messages.under(1)[1:]
    end, count, starts = all_.add_all(messages, rows, 200, bounds)
    kept = [b for b in decoded[1:] if b.tick0 < bounds[1] and b.tick0 + b.n > bounds[0]]
    for block in (decoded[0], *kept):
        one.add(block)
    assert (end, count) == (1100, sum(block.n for block in kept))
    assert [(s.sample, s.state.tolist(), s.previous_command) for s in starts] == [
        (b.tick0, b.state.tolist(), b.previous_command.item()) for b in kept
    ]
    for mine, right in zip(all_.index_and_flags(), one.index_and_flags(), strict=True):
        assert mine.tobytes() == right.tobytes()
        assert mine.dtype == right.dtype
    for name in decoded[0].columns:
        assert all_.column(name).tobytes() == one.column(name).tobytes()
    assert all_.column("drive_v").size == 0


def test_what_is_not_plain_is_not_taken(make):
    """Blocks that go back, or of other columns than the one before; nothing before a first one."""
    messages, records = messages_of(make, make.batch(300, 4), make.batch(500, 4))
    rows, first = messages.under(1), sample_block(records[0].data)
    blocks = Blocks()
    assert blocks.add_all(messages, rows, 0, EVERY) is None
    blocks.add(first)
    assert blocks.add_all(messages, rows, 301, EVERY) is None
    assert blocks.add_all(messages, rows[::-1].copy(), 0, EVERY) is None
    blocks._fields = blocks._fields[:-1]
    assert blocks.add_all(messages, rows, 0, EVERY) is None
    assert blocks.index_and_flags()[0].size == first.n


@pytest.mark.parametrize("changed", ["previous", "flags"])
def test_one_wrong_block_keeps_all_of_them_away(make, changed):
    messages, records = messages_of(make, make.batch(300, 4), make.batch(500, 4))
    blocks = Blocks()
    blocks.add(sample_block(records[0].data))
    data = messages.data
    if changed == "previous":
        field = bytes([15 << 3 | 2, 8])
        at = data.tobytes().rindex(field) + len(field)
        data[at : at + 8] = np.frombuffer(np.float64(np.nan).tobytes(), np.uint8)
    else:
        at = data.tobytes().rindex(bytes([9 << 3 | 2, 200 & 127 | 128, 1])) + 3
        data[at : at + 1] = 255
    assert blocks.add_all(messages, messages.under(1), 0, EVERY) is None


def test_ticks_of_a_chunk_are_those_one_by_one(make):
    """Through more of them than there is room for at first."""
    messages, records = messages_of(make, *(make.batch(200 * k, 4, seed=k) for k in range(9)))
    one, all_ = TickTable(), TickTable()
    for each in records:
        if each.channel_id == 2:
            one.add(tick_block(each.data))
    for _ in range(2):
        assert all_.add_all(messages, messages.under(2), EVERY) == 36
        mine, right = all_.ticks(), one.ticks()
        for name in ("first_sample", "deadline_ns", "late_ns", "exchange_ns"):
            assert getattr(mine, name).tobytes() == getattr(right, name).tobytes()
        assert all_.ticks().late_ns.size == 0
        for each in records:
            if each.channel_id == 2:
                one.add(tick_block(each.data))


@pytest.mark.parametrize(
    ("bounds", "kept"),
    [((0, 1), 8), ((350, 360), 8), ((351, 900), 0), ((-9, 0), 0), ((99, 200), 8)],
)
def test_ticks_that_all_lie_elsewhere_take_no_room(make, bounds, kept):
    """They are of samples 0 to 350; what is kept is cut later, to the tick."""
    messages, _ = messages_of(make, make.batch(0, 4), make.batch(200, 4))
    table = TickTable()
    assert table.add_all(messages, messages.under(2), bounds) == kept
    assert table.ticks().first_sample.size == kept


def test_ticks_beyond_any_run_are_not_taken(make):
    batch = make.batch(0, 4)
    batch.heads[2, 5] = -(2**60) - 1
    messages, _ = messages_of(make, make.batch(0, 4), batch)
    assert TickTable().add_all(messages, messages.under(2), EVERY) is None
    assert TickTable().add_all(messages, messages.under(2)[:1], EVERY) == 4
    assert messages.table[:, packed.CHANNEL].tolist() == [1, 2, 1, 2]
