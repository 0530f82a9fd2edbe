"""Messages of a recording's chunk: where they stand, and what is in their packed lists.

Whatever the bytes say, nothing is read outside of them. A message that is not as hilctl writes it
(fields in rising order, each once, lists packed) is refused, not guessed at: slower code knows
every way to write one.

Sources: MCAP specification, records; Protocol Buffers, encoding.
"""

from hilctl.base.types import I64, U8, U32
from hilctl.kernels.jit import kernel

TIME, START, BODY, END, CHANNEL = range(5)
"""Columns of a table of messages: log time, first byte, first byte of its data, first byte behind
it, and channel."""
PLACES = 5
NUMBER, LIST, ABSENT = 0, 2, -1
"""What a field is: a number, a packed list, or nothing that is known."""

_MESSAGE = 5
_FRAME_BYTES = 9
_HEAD_BYTES = 22
_INDEX_HEAD_BYTES = 6
_TIME_AT = _FRAME_BYTES + 6
_LONGEST = 63  # bits of a number
_MOST_CHANNELS = 16  # of a chunk; hilctl has four


@kernel("int64(uint8[::1], int64, int64)", inline=True)
def _little_endian(data: U8, at: int, size: int) -> int:
    value = 0
    for k in range(size):
        value |= int(data[at + k]) << (8 * k)
    return value


@kernel("UniTuple(int64, 2)(uint8[::1], int64, int64)")
def _varint(data: U8, at: int, end: int) -> tuple[int, int]:
    """Return a number and where it ends; there -1 where it has too many bits or the data ends."""
    value = shift = 0
    while at < end and shift < _LONGEST:
        byte = int(data[at])
        at += 1
        value |= (byte & 127) << shift
        if byte < 128:
            return value, at
        shift += 7
    return 0, -1


@kernel("int64(uint8[::1], int64[:, ::1])", nogil=True)
def walk_messages(data: U8, table: I64) -> int:
    """Find the messages of chunks that hold nothing else.

    Args:
        data: uint8[n], what the chunks hold, one behind the other.
        table: int64[m, PLACES], a row is filled for each; a log time as the bits of a uint64.

    Returns:
        Messages; -1 where there is another record, more of them than rows, or they do not fill the
        chunks to the last byte.
    """
    at = count = 0
    size = data.size
    while at < size:
        if size - at < _FRAME_BYTES + _HEAD_BYTES or data[at] != _MESSAGE:
            return -1
        length = _little_endian(data, at + 1, 8)
        if not _HEAD_BYTES <= length <= size - at - _FRAME_BYTES or count == table.shape[0]:
            return -1
        table[count, TIME] = _little_endian(data, at + _TIME_AT, 8)
        table[count, START] = at
        table[count, BODY] = at + _FRAME_BYTES + _HEAD_BYTES
        table[count, CHANNEL] = _little_endian(data, at + _FRAME_BYTES, 2)
        at += _FRAME_BYTES + length
        table[count, END] = at
        count += 1
    return count


@kernel("boolean(uint8[::1], int64[:, ::1], int64[:, ::1], int64[:, ::1])", nogil=True)
def are_indexes(raw: U8, indexes: I64, chunks: I64, table: I64) -> bool:
    """Compare message indexes, as they stand in the file, with the messages.

    Args:
        raw: uint8[k], bytes of the file.
        indexes: int64[r, 3], first byte of each message index in ``raw``, first behind it, and the
            number of its chunk, rising.
        chunks: int64[c, 3], first row of each chunk in ``table``, first behind it, and where what
            it holds begins among that of all.
        table: int64[m, PLACES], the messages, see :func:`walk_messages`.

    Returns:
        Whether every message is where one of them says, and none says anything else.
    """
    named = 0
    for k in range(indexes.shape[0]):
        at, end, chunk = indexes[k]
        if end - at < _INDEX_HEAD_BYTES or _little_endian(raw, at + 2, 4) != end - at - 6:
            return False
        channel = _little_endian(raw, at, 2)
        other = k - 1
        while other >= 0 and indexes[other, 2] == chunk:
            twice = _little_endian(raw, indexes[other, 0], 2) == channel
            if twice or k - other > _MOST_CHANNELS:
                return False
            other -= 1
        at += _INDEX_HEAD_BYTES
        for row in range(chunks[chunk, 0], chunks[chunk, 1]):
            if table[row, CHANNEL] == channel:
                if end - at < 16 or _little_endian(raw, at, 8) != table[row, TIME]:
                    return False
                if _little_endian(raw, at + 8, 8) != table[row, START] - chunks[chunk, 2]:
                    return False
                at += 16
                named += 1
        if at != end:
            return False
    return bool(named == table.shape[0])


@kernel(
    "boolean(uint8[::1], int64[:, ::1], int64[::1], int64[:, ::1], int64[:, ::1], int64[:, ::1])",
    nogil=True,
)
def find_fields(data: U8, table: I64, kinds: I64, numbers: I64, starts: I64, sizes: I64) -> bool:
    """Find numbers and lists of messages of one kind.

    Args:
        data: uint8[n], what the chunk holds.
        table: int64[m, PLACES], the messages, see :func:`walk_messages`.
        kinds: int64[f], what the field of each number is.
        numbers: int64[m, f], filled with numbers; 0 where there is none.
        starts: int64[m, f], filled with the first byte of each list; 0 where there is none.
        sizes: int64[m, f], filled with the bytes of each list.

    Returns:
        Whether all of them are as hilctl writes them.
    """
    for k in range(table.shape[0]):
        at, end, before = table[k, BODY], table[k, END], 0
        numbers[k, :] = 0
        starts[k, :] = 0
        sizes[k, :] = 0
        while at < end:
            tag, at = _varint(data, at, end)
            field = tag >> 3
            if at < 0 or not before < field < kinds.size or kinds[field] != tag & 7:
                return False
            before = field
            value, at = _varint(data, at, end)
            if at < 0:
                return False
            if kinds[field] == NUMBER:
                numbers[k, field] = value
            else:
                if value > end - at:
                    return False
                starts[k, field], sizes[k, field] = at, value
                at += value
    return True


@kernel("void(uint8[::1], int64[::1], int64[::1], uint8[::1], int64)", nogil=True)
def join_bytes(data: U8, starts: I64, sizes: I64, out: U8, at: int) -> None:
    """Copy stretches of bytes, one behind the other.

    Args:
        data: uint8[n].
        starts: int64[m], where each begins in ``data``.
        sizes: int64[m], its bytes; they lie in ``data``, and fit into ``out``.
        out: uint8[k], filled from ``at`` on.
        at: Where the first one goes.
    """
    for k in range(starts.size):
        source, target = data[starts[k] : starts[k] + sizes[k]], out[at : at + sizes[k]]
        for place in range(source.size):  # never negative, or it would be looked at byte by byte
            target[place] = source[place]
        at += sizes[k]


@kernel(
    "int64(uint8[::1], int64[::1], int64[::1], int64, uint32[::1], int64, int64[::1])",
    "int64(uint8[::1], int64[::1], int64[::1], int64, int64[::1], int64, int64[::1])",
    nogil=True,
)
def join_varints(
    data: U8, starts: I64, sizes: I64, largest: int, out: I64 | U32, at: int, counts: I64
) -> int:
    """Decode packed lists of numbers, one behind the other.

    Args:
        data: uint8[n].
        starts: int64[m], where each list begins in ``data``.
        sizes: int64[m], its bytes, which lie in ``data``.
        largest: No number may be larger.
        out: int64[k] or uint32[k], filled from ``at`` on.
        at: Where the first number goes.
        counts: int64[m], filled with the numbers of each list.

    Returns:
        Where the numbers end in ``out``; -1 where they do not fit, or a list is none.
    """
    for k in range(starts.size):
        place, end, first = starts[k], starts[k] + sizes[k], at
        while place < end:
            value = int(data[place])
            place += 1
            if value > 127:
                value, place = _varint(data, place - 1, end)
            if place < 0 or value > largest or at == out.size:
                return -1
            out[at] = value
            at += 1
        counts[k] = at - first
    return at


@kernel("void(int64[::1], int64[::1], int64[::1], int64)", nogil=True)
def join_ranges(firsts: I64, counts: I64, out: I64, at: int) -> None:
    """Write rising numbers, one range behind the other.

    Args:
        firsts: int64[m], the first number of each range.
        counts: int64[m], its numbers, which fit into ``out``.
        out: int64[k], filled from ``at`` on.
        at: Where the first one goes.
    """
    for k in range(firsts.size):
        for place in range(counts[k]):
            out[at + place] = firsts[k] + place
        at += counts[k]
