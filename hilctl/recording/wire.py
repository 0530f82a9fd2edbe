"""Blocks of samples and of ticks between protobuf bytes and arrays, without a Python number each.

Only what hilctl writes is taken apart here: fields in rising order, each once, lists packed. For
all else there is the protobuf library, which knows every way to write a message and takes ten times
as long.
"""

from collections.abc import Collection
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

from hilctl.base.arrays import F64, I64, U32
from hilctl.base.samples import RECORDED_FIELDS
from hilctl.recording.data import TICK_COLUMNS, Ticks

U64: TypeAlias = npt.NDArray[np.uint64]

_VARINT, _BYTES = 0, 2
_MORE = 0x80
_LONGEST_VARINT = 10
TICK0, N, _DROPPED, T_REL, FLAGS, STATE, PREVIOUS = 1, 2, 3, 4, 9, 14, 15
_COLUMNS = {field.block: field.name for field in RECORDED_FIELDS}
_NUMBERS = {TICK0, N, _DROPPED}
NUMBER_OF = {name: number for number, name in _COLUMNS.items()}
"""The number of each column's field in a ``SampleBlock``, by the field's name."""
_DOUBLES = {T_REL, STATE, PREVIOUS, *_COLUMNS}
_TICKS = dict(enumerate(TICK_COLUMNS, start=1))


def _kinds(numbers: Collection[int], lists: Collection[int]) -> I64:
    """Return what each field of a message is, by its number; nothing where it is none of it."""
    fields = range(max(*numbers, *lists) + 1)
    return np.array([_VARINT if f in numbers else _BYTES if f in lists else -1 for f in fields])


BLOCK_KINDS = _kinds(_NUMBERS, _DOUBLES | {FLAGS})
"""int64[f]: wire type of each field of a ``SampleBlock``; -1 where it is none."""
TICK_KINDS = _kinds((), _TICKS)
"""int64[f]: that of each field of a ``TickBlock``."""
LARGEST_N = 2**32
"""No block has as many samples."""
_LARGEST = 2**63 - 1
_NONE = np.empty(0)


@dataclass(frozen=True, slots=True)
class BlockArrays:
    """A ``SampleBlock``; nothing is known of the lengths of its arrays.

    Attributes:
        tick0: Index of its first sample.
        n: Its samples.
        dropped: Samples missing before it.
        flags: uint32[n].
        columns: float64[n] by name of their field; none that is empty.
        state: float64[s], the compensator's memory before it; mostly empty.
        previous_command: float64[1] or nothing: the command before it.
    """

    tick0: int
    n: int
    dropped: int
    flags: U32
    columns: dict[str, F64]
    state: F64
    previous_command: F64

    @classmethod
    def of(cls, message: Any) -> "BlockArrays":
        """Return what a ``SampleBlock`` of the protobuf library holds."""
        columns = {name: np.array(getattr(message, name)) for name in _COLUMNS.values()}
        return cls(
            tick0=message.tick0,
            n=message.n,
            dropped=message.dropped,
            flags=np.array(message.flags, dtype=np.uint32),
            columns={name: values for name, values in columns.items() if values.size},
            state=np.array(message.state, dtype=np.float64),
            previous_command=np.array(message.previous_command, dtype=np.float64),
        )


def sample_block(data: bytes) -> BlockArrays | None:
    """Return a ``SampleBlock`` by its bytes, as views of them; None where it is not plain."""
    found = _fields(data)
    if found is None:
        return None
    numbers, spans = found
    flags = varints(data, spans.pop(FLAGS, (0, 0)))
    plain = numbers.keys() <= _NUMBERS and spans.keys() <= _DOUBLES
    if flags is None or not plain or numbers.get(N, 0) >= LARGEST_N:
        return None
    spans.pop(T_REL, None)  # it is the index over the rate
    if any(size % 8 for _, size in spans.values()):
        return None
    doubles = {
        number: np.frombuffer(data, np.float64, size // 8, start)
        for number, (start, size) in spans.items()
    }
    return BlockArrays(
        tick0=numbers.get(TICK0, 0),
        n=numbers.get(N, 0),
        dropped=numbers.get(_DROPPED, 0),
        flags=flags.astype(np.uint32),
        state=doubles.pop(STATE, _NONE),
        previous_command=doubles.pop(PREVIOUS, _NONE),
        columns={_COLUMNS[number]: values for number, values in doubles.items() if values.size},
    )


def tick_block(data: bytes) -> Ticks | None:
    """Return a ``TickBlock`` by its bytes; None where it is not plain.

    Its columns may differ in length.
    """
    found = _fields(data)
    if found is None or found[0] or not _TICKS.keys() >= found[1].keys():
        return None
    columns = {name: np.empty(0, dtype=np.int64) for name in TICK_COLUMNS}
    for number, span in found[1].items():
        values = varints(data, span)
        if values is None:
            return None
        columns[_TICKS[number]] = _index(values) if number == 1 else signed(values)
    return Ticks(**columns)


def ticks_of(message: Any) -> Ticks:
    """Return what a ``TickBlock`` of the protobuf library holds."""
    first, *others = (getattr(message, name) for name in TICK_COLUMNS)
    signed = [np.array(values, dtype=np.int64) for values in others]
    return Ticks(_index(np.array(first, dtype=np.uint64)), *signed)


def varints(data: bytes, span: tuple[int, int]) -> U64 | None:
    """Return the numbers of a packed list; None where its bytes are none.

    Args:
        data: A message.
        span: Where the list begins in it, and its bytes.
    """
    if not span[1]:
        return np.empty(0, dtype=np.uint64)
    raw = np.frombuffer(data, np.uint8, span[1], span[0])
    if data[span[0] : span[0] + span[1]].isascii():  # each below 128
        return raw.astype(np.uint64)
    last = np.flatnonzero(raw < _MORE)
    if raw[-1] >= _MORE:
        return None
    first = np.concatenate((np.zeros(1, dtype=np.int64), last[:-1] + 1))
    sizes = last - first + 1
    if sizes.max() > _LONGEST_VARINT:
        return None
    place = np.arange(raw.size) - np.repeat(first, sizes)
    parts = (raw & np.uint8(_MORE - 1)).astype(np.uint64) << (7 * place).astype(np.uint64)
    return np.asarray(np.bitwise_or.reduceat(parts, first), dtype=np.uint64)


def _index(values: U64) -> I64:
    """Return sample indices; one that no int64 holds stays too large for any run."""
    return np.minimum(values, np.uint64(_LARGEST)).astype(np.int64)


def signed(values: U64) -> I64:
    """Undo the zigzag of numbers with a sign: their lowest bit says it."""
    found: I64 = (values >> np.uint64(1)).view(np.int64) ^ -(values & np.uint64(1)).view(np.int64)
    return found


def _fields(data: bytes) -> tuple[dict[int, int], dict[int, tuple[int, int]]] | None:
    """Return numbers by field, and where the bytes of each other field begin and how many.

    None where fields do not rise, as they do where each stands there once, or are of other kinds.
    """
    numbers: dict[int, int] = {}
    at = before = 0
    try:
        while at < len(data) and data[at] & 7 == _VARINT:
            tag, after = _varint(data, at)
            numbers[tag >> 3], at = _varint(data, after)
            if tag >> 3 <= before:
                return None
            before = tag >> 3
        layout = _layout(data, at, before)
    except (IndexError, OverflowError):  # it ends within a number, or in none
        return None
    if layout is None:
        return None
    return numbers, {number: (at + start, size) for number, start, size in layout.spans}


@dataclass(frozen=True, slots=True)
class _Layout:
    """Where lists stand in a message, from the first of them on."""

    heads: list[tuple[int, bytes]]
    """What stands before each list, and where: its tag and length."""
    spans: list[tuple[int, int, int]]
    """Field, place and bytes of each list."""


# One message after the other has the same lists of the same lengths: looking at what stands between
# them takes a fifth of the time of reading it. By the bytes that the lists take together.
_LAYOUTS: dict[int, _Layout] = {}
_MOST_LAYOUTS = 64


def _layout(data: bytes, first: int, before: int) -> _Layout | None:
    known = _LAYOUTS.get(len(data) - first)
    if known and all(data.startswith(head, first + start) for start, head in known.heads):
        return known
    found = _Layout([], [])
    at = first
    while at < len(data):
        tag, begin = _varint(data, at)
        size, begin = _varint(data, begin)
        if tag & 7 != _BYTES or tag >> 3 <= before or size > len(data) - begin:
            return None
        before = tag >> 3
        found.heads.append((at - first, data[at:begin]))
        found.spans.append((before, begin - first, size))
        at = begin + size
    if len(_LAYOUTS) >= _MOST_LAYOUTS:
        _LAYOUTS.clear()
    _LAYOUTS[len(data) - first] = found
    return found


def _varint(data: bytes, at: int) -> tuple[int, int]:
    """Return a number of less than 63 bits and where it ends.

    Raises:
        OverflowError: It is longer.
        IndexError: The bytes end first.
    """
    value = data[at]
    if value < _MORE:
        return value, at + 1
    value -= _MORE
    for shift in range(7, 63, 7):
        at += 1
        more = data[at]
        value |= (more & (_MORE - 1)) << shift
        if more < _MORE:
            return value, at + 1
    raise OverflowError
