"""Messages and packed lists taken apart by kernels: as the libraries do, or not at all."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.data_stream import RecordBuilder
from mcap.records import Message, Metadata

from hilctl.kernels import packed
from hilctl.recording import schema, wire

NUMBERS = st.integers(0, 2**63 - 1)


def raw(*records):
    builder = RecordBuilder()
    for record in records:
        record.write(builder)
    return builder.end()


def walked(data, rows=9):
    table = np.full((rows, packed.PLACES), -7)
    count = packed.walk_messages(np.frombuffer(data, np.uint8).copy(), table)
    return table[:count] if count >= 0 else None


MESSAGES = [Message(channel_id=k, log_time=100 + k, data=b"x" * k, publish_time=0, sequence=k)
            for k in (3, 1, 0)]  # fmt: skip


def test_messages_are_found():
    found = walked(raw(*MESSAGES))
    lengths = np.array([9 + 22 + len(each.data) for each in MESSAGES])
    assert found[:, packed.CHANNEL].tolist() == [3, 1, 0]
    assert found[:, packed.TIME].tolist() == [103, 101, 100]
    assert found[:, packed.END].tolist() == np.cumsum(lengths).tolist()
    assert found[:, packed.START].tolist() == (np.cumsum(lengths) - lengths).tolist()
    assert (found[:, packed.BODY] - found[:, packed.START]).tolist() == [31, 31, 31]


def test_what_is_not_messages_to_the_last_byte_is_refused():
    whole = raw(*MESSAGES)
    assert walked(whole, rows=2) is None
    assert walked(whole + raw(Metadata("a", {}))) is None
    for size in range(len(whole)):
        found = walked(whole[:size])
        assert (found is None) == (size not in {0, 34, 66})
    for length in (2**63, 2**64 - 1, 21, 10**6):
        assert walked(whole[:1] + length.to_bytes(8, "little") + whole[9:]) is None


def indexes_of(table, *, channels=(3, 1, 0), times=0, twice=False):
    """Message indexes as bytes, and where they stand in them."""
    out, places = b"", []
    for channel in (*channels, *([channels[0]] if twice else [])):
        rows = table[table[:, packed.CHANNEL] == channel]
        pairs = (rows[:, : packed.BODY] + [times, 0]).tobytes()
        body = np.uint16(channel).tobytes() + np.uint32(len(pairs)).tobytes() + pairs
        places.append((len(out), len(out) + len(body), 0))
        out += body
    return np.frombuffer(out, np.uint8).copy(), np.array(places)


def test_indexes_must_name_every_message_once():
    table = walked(raw(*MESSAGES, MESSAGES[0]))
    chunks = np.array([[0, 4, 0]])
    bytes_of, places = indexes_of(table)
    assert packed.are_indexes(bytes_of, places, chunks, table)
    assert not packed.are_indexes(bytes_of, places[:2], chunks, table)
    assert not packed.are_indexes(bytes_of, places, np.array([[0, 4, 1]]), table)
    assert not packed.are_indexes(bytes_of, places - [0, 1, 0], chunks, table)
    for wrong in (
        {"times": 1},
        {"channels": (3, 3)},
        {"twice": True},
        {"channels": (3, 1, 0, 7, 7)},
    ):
        assert not packed.are_indexes(*indexes_of(table, **wrong), chunks, table)


def found_in(data, kinds=wire.BLOCK_KINDS):
    table = np.array([[0, 0, 0, len(data), 1]])
    out = [np.full((1, kinds.size), -7) for _ in range(3)]
    plain = packed.find_fields(np.frombuffer(data, np.uint8).copy(), table, kinds, *out)
    return [each[0] for each in out] if plain else None


@settings(max_examples=30)
@given(NUMBERS, st.integers(0, 2**32 - 1), st.lists(st.floats(), max_size=5))
def test_fields_are_those_of_the_library(tick0, samples, values):
    message = schema.message("SampleBlock")
    message.tick0, message.n = tick0, samples
    message.current_a.extend(values)
    data = message.SerializeToString()
    numbers, starts, sizes = found_in(data)
    field = wire.NUMBER_OF["current_a"]
    assert (numbers[wire.TICK0], numbers[wire.N]) == (tick0, samples)
    assert sizes.sum() == sizes[field] == 8 * len(values)
    out = np.zeros(8 * len(values) + 3, dtype=np.uint8)
    packed.join_bytes(np.frombuffer(data, np.uint8).copy(), starts[[field]], sizes[[field]], out, 3)
    assert out[3:].tobytes() == np.array(values).tobytes()


@pytest.mark.parametrize("data", [
    b"\x08\x05\x08\x06",  # a field twice
    b"\x10\x05\x08\x06",  # falling
    b"\x0a\x00", b"\x20\x05", b"\x7d\0\0\0\0", b"\x9a\x01\x00", b"\x00\x00",  # of other kinds
    b"\x08", b"\x08\x80", b"\x22\x09" + bytes(8), b"\x08" + b"\xff" * 9 + b"\x01",  # short, long
])  # fmt: skip
def test_fields_that_hilctl_does_not_write_are_refused(data):
    assert found_in(data) is None
    assert wire.sample_block(data) is None


@given(st.binary(max_size=40))
def test_no_bytes_mislead(data):
    """Whatever stands there, lists lie within it, and the slower code finds the same ones."""
    found = found_in(data)
    if found is not None:
        numbers, starts, sizes = found
        assert ((starts + sizes) <= len(data)).all()
        slow = wire.sample_block(data)
        assert slow is None or (slow.tick0, slow.n) == (numbers[wire.TICK0], numbers[wire.N])


@pytest.mark.parametrize("kind", [np.int64, np.uint32])
@settings(max_examples=40)
@given(lists=st.lists(st.lists(st.integers(0, 2**31) | NUMBERS, max_size=5), max_size=4))
def test_packed_numbers_are_those_of_the_library(kind, lists):
    message = schema.message("TickBlock")
    parts = []
    for values in lists:
        message.Clear()
        message.first_sample.extend(values)
        parts.append(message.SerializeToString()[2:])
    sizes = np.array([len(part) for part in parts], dtype=np.int64)
    starts = np.cumsum(sizes) - sizes
    flat = [value for values in lists for value in values]
    largest = 2**32 - 1 if kind is np.uint32 else 2**63 - 1
    out, counts = np.zeros(1 + len(flat), dtype=kind), np.zeros(len(lists), dtype=np.int64)
    data = np.frombuffer(b"".join(parts), np.uint8).copy()
    end = packed.join_varints(data, starts, sizes, largest, out, 1, counts)
    if max(flat, default=0) > largest:
        assert end == -1
        return
    assert end == 1 + len(flat)
    assert out[1:].tolist() == flat
    assert counts.tolist() == [len(values) for values in lists]
    if flat:
        assert packed.join_varints(data, starts, sizes, largest, out[:-1].copy(), 1, counts) == -1


def test_a_list_that_ends_in_a_number_is_refused():
    data, one = np.array([5, 0x85], dtype=np.uint8), np.array([0])
    assert packed.join_varints(data, one, one + 2, 99, np.zeros(9, dtype=np.int64), 0, one) == -1


def test_ranges_follow_one_another():
    out = np.zeros(6, dtype=np.int64)
    packed.join_ranges(np.array([7, 20]), np.array([2, 3]), out, 1)
    assert out.tolist() == [0, 7, 8, 20, 21, 22]
