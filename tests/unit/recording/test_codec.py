"""Blocks, ticks and scope messages are, byte for byte, those of the published descriptor."""

import numpy as np
import pytest
from google.protobuf.message import DecodeError
from hypothesis import example, given
from hypothesis.strategies import binary, floats, integers, lists, sampled_from, tuples

from hilctl.base.samples import RECORDED_FIELDS
from hilctl.recording import codec, schema
from hilctl.recording.recording import TICK_COLUMNS

VALUES = floats(width=64) | sampled_from([0.0, -0.0, 5e-324])
SCOPE = ["t_rel", *(each.name for each in RECORDED_FIELDS if each.scope)]


def block_message(**fields):
    block = schema.message_class("SampleBlock")()
    block.tick0, block.n = 300, 3
    block.flags.extend(fields.pop("flags", [0, 1, 2]))
    for name in ("t_rel", *(field.name for field in RECORDED_FIELDS)):
        getattr(block, name).extend(fields.pop(name, [1.5, -0.0, float("nan")]))
    for name, value in fields.items():
        getattr(block, name).extend(value) if isinstance(value, list) else setattr(
            block, name, value
        )
    return block


@pytest.mark.parametrize("fields", [
    {},
    {"flags": [0, 127, 128]},
    {"flags": [2**32 - 1, 2**17, 3]},
    {"flags": []},
    {"tick0": 0, "dropped": 2**40},
    {"tick0": 2**62, "state": [1.0, 2.0], "previous_command": [0.5]},
    {"measured_a": [], "input_um": [1.0]},
])  # fmt: skip
def test_a_block_is_that_of_the_published_descriptor(fields):
    message = block_message(**fields)
    data = message.SerializeToString()
    found = codec.decode_block(data)
    assert (found.tick0, found.n, found.dropped) == (message.tick0, message.n, message.dropped)
    assert (found.flags.dtype, found.flags.tolist()) == (np.uint32, list(message.flags))
    lists_of = {"state": found.state, "previous_command": found.previous_command, **found.columns}
    for name, values in lists_of.items():
        assert values.tobytes() == np.array(getattr(message, name), dtype=np.float64).tobytes()
    filled = {each.name for each in RECORDED_FIELDS if getattr(message, each.name)}
    assert found.columns.keys() == filled
    assert codec.encode_block(found, np.array(message.t_rel)) == data


@given(lists(integers(0, 2**64 - 1)), lists(integers(-(2**63), 2**63 - 1)))
def test_ticks_are_those_of_the_published_descriptor(first, times):
    message = schema.message_class("TickBlock")()
    message.first_sample.extend(first)
    for name in TICK_COLUMNS[1:]:
        getattr(message, name).extend(times)
    data = message.SerializeToString()
    found = codec.decode_ticks(data)
    assert found.first_sample.tolist() == [min(each, 2**63 - 1) for each in first]
    for name in TICK_COLUMNS[1:]:
        assert (getattr(found, name).dtype, getattr(found, name).tolist()) == (np.int64, times)
    if max(first, default=0) < 2**63:
        assert codec.encode_ticks({name: getattr(found, name) for name in TICK_COLUMNS}) == data


@given(
    lists(
        tuples(
            integers(0, 2**62), integers(0, 2**32 - 1) | sampled_from([0, 127, 128]),
            lists(VALUES, min_size=len(SCOPE), max_size=len(SCOPE)),
        ),
        max_size=5,
    )
)  # fmt: skip
@example([])
@example([(0, 0, [0.0] * len(SCOPE)), (128, 0, [-0.0] * len(SCOPE))])
def test_scope_messages_read_back(rows):
    values = np.array([row[2] for row in rows], dtype=np.float64).reshape(-1, len(SCOPE))
    found = codec.encode_scope(
        np.array([row[0] for row in rows], dtype=np.int64),
        np.array([row[1] for row in rows], dtype=np.uint32),
        dict(zip(SCOPE, values.T, strict=True)),
    )
    for data, (sample, flags, row) in zip(found, rows, strict=True):
        message = schema.message_class("Sample").FromString(data)
        assert (message.sample, message.flags) == (sample, flags)
        read = np.array([getattr(message, name) for name in SCOPE])
        assert read.tobytes() == np.array(row, dtype=np.float64).tobytes()


@given(binary(max_size=40))
def test_any_bytes_are_decoded_or_refused(data):
    for decode in (codec.decode_block, codec.decode_ticks):
        try:
            decode(data)
        except (DecodeError, ValueError):
            continue


@pytest.mark.parametrize("data", [b"\x2a\x07" + bytes(7), b"\x4a\x01\xff", b"\x10", b"\x0f"])
def test_damaged_blocks_are_refused(data):
    with pytest.raises((DecodeError, ValueError)):
        codec.decode_block(data)
