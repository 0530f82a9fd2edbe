"""Blocks by their bytes: the same as the protobuf library gives, or left to it."""

import io

import numpy as np
import pytest
from hypothesis import given
from hypothesis.strategies import binary, integers, lists
from mcap.records import Message

from hilctl.base.samples import RECORDED_FIELDS
from hilctl.recording import schema, wire
from hilctl.recording.data import TICK_COLUMNS
from hilctl.recording.salvage import Salvage


def block_message(**fields):
    block = schema.message("SampleBlock")
    block.tick0, block.n = 300, 3
    block.flags.extend(fields.pop("flags", [0, 1, 2]))
    for name in ("t_rel", *(field.name for field in RECORDED_FIELDS)):
        getattr(block, name).extend(fields.pop(name, [1.5, -0.0, float("nan")]))
    for name, value in fields.items():
        getattr(block, name).extend(value) if isinstance(value, list) else setattr(
            block, name, value
        )
    return block


def same(found, message):
    expected = wire.BlockArrays.of(message)
    numbers = [(each.tick0, each.n, each.dropped) for each in (found, expected)]
    assert numbers[0] == numbers[1]
    for name in ("flags", "state", "previous_command"):
        one, other = getattr(found, name), getattr(expected, name)
        assert (one.dtype, one.tobytes()) == (other.dtype, other.tobytes()), name
    columns = [{k: v.tobytes() for k, v in each.columns.items()} for each in (found, expected)]
    assert columns[0] == columns[1]


@pytest.mark.parametrize(
    "fields",
    [
        {},
        {"flags": [0, 127, 128]},
        {"flags": [2**32 - 1, 2**17, 3]},
        {"flags": []},
        {"tick0": 0, "dropped": 2**40},
        {"tick0": 2**62, "state": [1.0, 2.0], "previous_command": [0.5]},
        {"measured_a": [], "input_um": [1.0]},
    ],
)
def test_a_block_is_what_the_library_reads(fields):
    message = block_message(**fields)
    data = message.SerializeToString()
    for _ in range(2):  # the second time by its layout
        same(wire.sample_block(data), message)


@given(lists(integers(0, 2**64 - 1)), lists(integers(-(2**63), 2**63 - 1)))
def test_ticks_are_what_the_library_reads(first, times):
    message = schema.message("TickBlock")
    message.first_sample.extend(first)
    for name in TICK_COLUMNS[1:]:
        getattr(message, name).extend(times)
    found, expected = wire.tick_block(message.SerializeToString()), wire.ticks_of(message)
    for name in TICK_COLUMNS:
        one, other = getattr(found, name), getattr(expected, name)
        assert (one.dtype, one.tolist()) == (other.dtype, other.tolist())
    assert [min(each, 2**63 - 1) for each in first] == found.first_sample.tolist()


@given(binary(max_size=40))
def test_any_bytes_are_a_block_or_left_to_the_library(data):
    wire.sample_block(data)
    wire.tick_block(data)


def test_what_is_written_another_way_is_left_to_the_library():
    """Fields in another order, twice, unknown, not packed, cut, or no whole numbers of 8 bytes."""
    good = block_message().SerializeToString()
    assert wire.sample_block(good) is not None
    ones = b"\xff" * 10
    for data in (
        good + b"\x08\x01", b"\x10\x03" + good, good + b"\xfa\x07\x00", good[:-1],
        b"\x11" + bytes(8), b"\x2a\x07" + bytes(7), b"\x4a\x01\xff", b"\x10" + ones[:5],
        b"\x4a\x0b" + ones + b"\x01", b"\x08" + ones + b"\x01",
    ):  # fmt: skip
        assert wire.sample_block(data) is None
    assert wire.tick_block(b"\x08\x01") is None


def test_all_that_is_recorded_is_plain(make):
    """Or reading takes ten times as long."""
    stream = io.BytesIO()
    make.write(stream, [make.batch(2000 * k, 40, seed=k) for k in range(3)])
    kinds = {1: wire.sample_block, 2: wire.tick_block}
    found = [
        kinds[record.channel_id](record.data)
        for record in Salvage(stream).records()
        if isinstance(record, Message) and record.channel_id in kinds
    ]
    assert len(found) > 4
    assert all(each is not None for each in found)


def test_layouts_do_not_pile_up(monkeypatch):
    """Each length of a message may have its own; a file has few, a hostile one has many."""
    monkeypatch.setattr(wire, "_LAYOUTS", {})
    for n in range(1000):
        size = n % 128 // 8 * 8
        assert wire.sample_block(b"\x2a" + bytes([size]) + bytes(size)) is not None
        assert wire.sample_block(
            b"\x2a\x00" * (n % 2) + b"\x4a" + bytes([n % 100]) + bytes(n % 100)
        )
    assert len(wire._LAYOUTS) <= 64


def test_a_layout_of_the_same_length_with_other_lists_is_not_taken():
    """The same bytes, but of two other columns."""
    one, other = schema.message("SampleBlock"), schema.message("SampleBlock")
    one.reference_um.extend([1.0, 2.0])
    other.wanted_a.extend([1.0, 2.0])
    for message in (one, other):
        same(wire.sample_block(message.SerializeToString()), message)


def test_flags_are_numbers_of_32_bits():
    assert wire.varints(b"\x01\x80\x01", (0, 3)).tolist() == [1, 128]
    assert np.array_equal(wire.varints(b"", (0, 0)), [])
