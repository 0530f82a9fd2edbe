"""Conversion of samples and ticks between protobuf bytes and arrays.

Blocks of samples use the twin of their message, which declares packed lists as ``bytes``
(:func:`hilctl.recording.schema.message_class`), so that no sample becomes a Python number.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from hilctl.base.samples import RECORDED_FIELDS
from hilctl.base.types import F64, I64, U8, U32
from hilctl.recording import schema
from hilctl.recording.recording import TICK_COLUMNS, Ticks

_COLUMNS = tuple(field.name for field in RECORDED_FIELDS)
_BLOCK = schema.message_class("SampleBlock")
_BLOCK_TWIN = schema.message_class("SampleBlock", lists_as_bytes=True)
_TICKS = schema.message_class("TickBlock")
_SCOPE = schema.message_class("Sample")
_ONE_BYTE = 0x80
"""Numbers below it take one byte in a packed list."""
_LARGEST = 2**63 - 1


@dataclass(frozen=True, slots=True)
class BlockArrays:
    """Content of a ``SampleBlock``; the lengths of its arrays are not checked.

    Attributes:
        dropped: Samples missing before the block.
        flags: uint32[n].
        columns: float64[n] by name of their field; empty ones are omitted.
        state: float64[s], the compensator's memory before the block; usually empty.
        previous_command: float64[1] or empty: the command before the block.
        aux: float64[exchanges * channels], auxiliary channels of each exchange; may be empty.
    """

    tick0: int
    n: int
    dropped: int
    flags: U32
    columns: Mapping[str, F64]
    state: F64
    previous_command: F64
    aux: F64


def encode_block(block: BlockArrays, t_rel: F64) -> bytes:
    """Return a ``SampleBlock``; ``t_rel``, float64[n], is the time of each sample in s."""
    lists = {
        "t_rel": t_rel,
        "state": block.state,
        "previous_command": block.previous_command,
        "aux": block.aux,
        **block.columns,
    }
    twin = _BLOCK_TWIN(
        tick0=block.tick0,
        n=block.n,
        dropped=block.dropped,
        flags=_packed_flags(block.flags),
        **{name: values.tobytes() for name, values in lists.items()},
    )
    data: bytes = twin.SerializeToString()
    return data


def decode_block(data: bytes) -> BlockArrays:
    """Return the content of a ``SampleBlock``; its arrays are read-only.

    Raises:
        DecodeError: The bytes are not a message.
        ValueError: A list does not hold whole numbers of 8 bytes.
    """
    twin: Any = _BLOCK_TWIN.FromString(data)
    columns = {name: np.frombuffer(raw) for name in _COLUMNS if (raw := getattr(twin, name))}
    return BlockArrays(
        tick0=twin.tick0,
        n=twin.n,
        dropped=twin.dropped,
        flags=_unpacked_flags(twin.flags),
        columns=columns,
        state=np.frombuffer(twin.state),
        previous_command=np.frombuffer(twin.previous_command),
        aux=np.frombuffer(twin.aux),
    )


def _packed_flags(flags: U32) -> bytes:
    if not flags.size or flags.max() < _ONE_BYTE:
        return flags.astype(np.uint8).tobytes()
    twin: Any = _BLOCK_TWIN.FromString(_BLOCK(flags=flags.tolist()).SerializeToString())
    packed: bytes = twin.flags
    return packed


def _unpacked_flags(packed: bytes) -> U32:
    if packed.isascii():  # each below 128
        narrow: U8 = np.frombuffer(packed, dtype=np.uint8)
        return narrow.astype(np.uint32)
    block: Any = _BLOCK.FromString(_BLOCK_TWIN(flags=packed).SerializeToString())
    return np.array(block.flags, dtype=np.uint32)


def encode_ticks(columns: Mapping[str, I64]) -> bytes:
    """Return a ``TickBlock`` of the columns of :class:`~hilctl.recording.recording.Ticks`."""
    message = _TICKS(**{name: values.tolist() for name, values in columns.items()})
    data: bytes = message.SerializeToString()
    return data


def decode_ticks(data: bytes) -> Ticks:
    """Return the columns of a ``TickBlock``, of any lengths; raise DecodeError if it is invalid."""
    message: Any = _TICKS.FromString(data)
    first, *others = (getattr(message, name) for name in TICK_COLUMNS)
    # An index beyond int64 stays too large for any run.
    indices = np.minimum(np.array(first, dtype=np.uint64), np.uint64(_LARGEST)).astype(np.int64)
    return Ticks(indices, *(np.array(values, dtype=np.int64) for values in others))


def encode_scope(samples: I64, flags: U32, columns: Mapping[str, F64]) -> Iterator[bytes]:
    """Yield a ``Sample`` message per sample of the columns, float64[n] by name of their field."""
    rows = zip(*(values.tolist() for values in columns.values()), strict=True)
    for sample, flag, row in zip(samples.tolist(), flags.tolist(), rows, strict=True):
        fields = dict(zip(columns, row, strict=True))
        yield _SCOPE(sample=sample, flags=flag, **fields).SerializeToString()
