"""Chunks of a long recording, read and decompressed in a thread before they are asked for."""

import zlib
from collections import deque
from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from io import FileIO
from typing import NamedTuple

import numpy as np
import zstandard
from mcap.opcode import Opcode
from mcap.writer import MCAP0_MAGIC as MAGIC

from hilctl.base.types import U8
from hilctl.recording.allowance import LARGEST_CHUNK_BYTES
from hilctl.recording.chunks import Messages, kernels
from hilctl.recording.records import CHUNK_HEAD, FRAME, LARGEST_BYTES, LENGTH

_READ_BYTES = 2 * 2**20
_MOST_BYTES = 8 * 2**20  # of a batch, uncompressed
_BATCHES = 3
_MOST_STARTS = 16
_MOST_CHUNKS = 1024
_FRAME_HEAD_BYTES = 18
_ZSTD = b"zstd"
_CHUNK, _INDEX = int(Opcode.CHUNK), int(Opcode.MESSAGE_INDEX)
_NOTHING = np.empty(0, dtype=np.uint8)


@dataclass(frozen=True, slots=True)
class ChunkRun:
    """Chunks that follow one another, whole, of messages only, and each with its right indexes.

    Attributes:
        places: Offset of each in the file.
        end: Offset of the first byte behind them and their indexes.
        messages: What they hold.
    """

    places: tuple[int, ...]
    end: int
    messages: Messages


class _Chunk(NamedTuple):
    """Where a chunk stands in a batch, where its data begins and ends, its bytes, and their sum."""

    start: int
    begin: int
    end: int
    size: int
    crc: int


@dataclass(frozen=True, slots=True)
class _Batch:
    """Records that follow one another: their bytes, and what they hold if all are chunks.

    Attributes:
        start: Offset of the first.
        raw: uint8[k], their bytes.
        chunks: Those of them that are chunks.
        indexes: int64[r, 3], see :func:`hilctl.kernels.packed.are_indexes`.
        data: uint8[n], what the chunks hold; None where one is damaged.
        crc: Checksum of all bytes of the file before them; None where not all were read.
    """

    start: int
    raw: U8
    chunks: Sequence[_Chunk] = ()
    indexes: Sequence[tuple[int, int, int]] = ()
    data: U8 | None = None
    crc: int | None = None

    @property
    def stop(self) -> int:
        return self.start + self.raw.size

    def run(self) -> ChunkRun | None:
        """Return the chunks, if nothing is wrong with any of them."""
        if self.data is None or not self.chunks:
            return None
        begins = np.cumsum([0, *(each.size for each in self.chunks)])
        messages = Messages.of(self.data)
        if messages is None:
            return None
        packed = kernels()
        rows = np.searchsorted(messages.table[:, packed.START], begins[1:-1])
        if not np.isin(begins[1:-1], messages.table[:, packed.START]).all():
            return None  # a message goes from one chunk to the next
        bounds = np.concatenate(([0], rows, [len(messages.table)]))
        chunks = np.column_stack((bounds[:-1], bounds[1:], begins[:-1]))
        indexes = np.array(self.indexes, dtype=np.int64).reshape(-1, 3)
        if not packed.are_indexes(self.raw, indexes, chunks, messages.table):
            return None
        return ChunkRun(tuple(self.start + c.start for c in self.chunks), self.stop, messages)


class ReadAhead:
    """Reads a file some batches of records ahead of whoever asks.

    Decompressing leaves the interpreter to others, and goes over many chunks at once, so that it is
    not held up where they seldom let go of it.

    Args:
        stream: The file, opened for this alone, without a buffer.
    """

    def __init__(self, stream: FileIO) -> None:
        self._file = stream
        self._thread = ThreadPoolExecutor(1, thread_name_prefix="read-ahead")
        self._coming: deque[Future[_Batch]] = deque()
        self._batch = _Batch(0, _NOTHING)
        self._walk = _Walk(self._file, 0, first=True)
        self._starts = 0

    def close(self) -> None:
        """End the thread; nothing may be asked for afterwards."""
        self._thread.shutdown(cancel_futures=True)

    def chunks(self, at: int) -> ChunkRun | None:
        """Return chunks from some place on; None where they have to be looked at one by one.

        They are given out once, as they take memory.
        """
        while at >= self._batch.stop:
            gone_by = at - self._batch.stop > _READ_BYTES  # as where a stretch is read
            if (gone_by or not self._coming) and not self._begin(at):
                return None
            self._batch = self._coming.popleft().result()
            if not self._batch.raw.size:
                self._coming.clear()
                return None
            self._coming.append(self._thread.submit(self._walk.next_batch))
        run = self._batch.run() if self._batch.start == at else None
        if run is not None:
            self._batch = _Batch(run.end, _NOTHING)
        return run

    def read(self, at: int, size: int) -> bytes | None:
        """Return bytes from some place on; None where they are not at hand."""
        first = at - self._batch.start
        here = 0 <= first <= self._batch.raw.size - size
        return self._batch.raw[first : first + size].tobytes() if here else None

    def crc(self, stop: int) -> int | None:
        """Return the checksum of all bytes up to some place; None where it is not at hand."""
        before, batch = self._batch.crc, self._batch
        if before is None or not 0 <= stop - batch.start <= batch.raw.size:
            return None
        return zlib.crc32(batch.raw[: stop - batch.start].data, before)

    def _begin(self, at: int) -> bool:
        """Begin at another place; return False of a file that has been begun too often."""
        if self._starts == _MOST_STARTS:
            return False
        self._starts += 1
        for each in self._coming:
            each.cancel()
        self._walk = _Walk(self._file, at, first=self._starts == 1)
        self._batch = _Batch(at, _NOTHING)
        submit = self._thread.submit
        self._coming = deque(submit(self._walk.next_batch) for _ in range(_BATCHES))
        return True


class _Walk:
    """Goes over the records of a file, a batch at a time.

    Args:
        file: The file; its place is moved.
        at: Where a record begins.
        first: Whether the next chunk is the first that is read of it.
    """

    def __init__(self, file: FileIO, at: int, *, first: bool) -> None:
        self._file, self._at, self._first = file, at, first
        self._crc = zlib.crc32(MAGIC) if at == len(MAGIC) else None

    def next_batch(self) -> _Batch:
        """Return the next batch; of no bytes where no whole record follows."""
        start, raw = self._at, self._read(_READ_BYTES)
        if raw.size >= FRAME.size:
            first_bytes = FRAME.size + FRAME.unpack_from(raw.data)[1]
            if raw.size < first_bytes <= LARGEST_BYTES:
                raw = self._read(first_bytes + _READ_BYTES)
        # The first chunk has schemas and channels, too: it can't be of a run.
        chunks, indexes, end = _records(raw.data, 1 if self._first else _MOST_CHUNKS)
        self._at, self._first = start + end, self._first and not chunks
        data = _inflated(raw.data, chunks)
        before = self._crc
        self._crc = None if before is None else zlib.crc32(raw[:end].data, before)
        return _Batch(start, raw[:end], chunks, indexes, data, before)

    def _read(self, size: int) -> U8:
        raw = np.empty(size, dtype=np.uint8)
        self._file.seek(self._at)
        return raw[: self._file.readinto(raw.data) or 0]


def _records(raw: memoryview, most: int) -> tuple[list[_Chunk], list[tuple[int, int, int]], int]:
    """Return chunks and their message indexes, or where there is none records before the next.

    Args:
        raw: Bytes that begin with a record.
        most: Chunks at most.

    Returns:
        The chunks, place and number of chunk of each message index, and where they end.
    """
    chunks: list[_Chunk] = []
    indexes: list[tuple[int, int, int]] = []
    at = end = total = 0
    while at + FRAME.size <= len(raw):
        opcode, length = FRAME.unpack_from(raw, at)
        after = at + FRAME.size + length
        if chunks and opcode != _INDEX:
            end = at  # what stands behind a chunk is known to be complete
        if after > len(raw):
            break
        chunk = _chunk_of(raw, at, after) if opcode == _CHUNK else None
        if chunk is not None:
            total += chunk.size
            if len(chunks) == most or (chunks and total > _MOST_BYTES) or (end and not chunks):
                break
            chunks.append(chunk)
        elif chunks and opcode != _INDEX:
            break
        elif chunks:
            indexes.append((at + FRAME.size, after, len(chunks) - 1))
        else:
            end = after
        at = after
    kept = [each for each in chunks if each.end <= end]
    return kept, [each for each in indexes if each[2] < len(kept)], end


def _chunk_of(raw: memoryview, at: int, end: int) -> _Chunk | None:
    """Return a chunk that says right how long it is; None of any other, or without a checksum."""
    begin = at + FRAME.size + CHUNK_HEAD.size + len(_ZSTD) + LENGTH.size
    if begin > end or raw[begin - LENGTH.size - len(_ZSTD) : begin - LENGTH.size] != _ZSTD:
        return None
    _, _, size, crc, name_bytes = CHUNK_HEAD.unpack_from(raw, at + FRAME.size)
    (length,) = LENGTH.unpack_from(raw, begin - LENGTH.size)
    if name_bytes != len(_ZSTD) or begin + length != end or not crc:
        return None
    head = raw[begin : min(end, begin + _FRAME_HEAD_BYTES)]
    try:
        says = zstandard.frame_content_size(head)
    except zstandard.ZstdError:
        return None
    return _Chunk(at, begin, end, size, crc) if says == size <= LARGEST_CHUNK_BYTES else None


def _inflated(raw: memoryview, chunks: Sequence[_Chunk]) -> U8 | None:
    """Return what chunks hold, one behind the other; None where one of them is damaged.

    Args:
        raw: The bytes that they stand in.
        chunks: The chunks.
    """
    data = np.empty(sum(each.size for each in chunks), dtype=np.uint8)
    frames = b"".join([raw[each.begin : each.end] for each in chunks])
    decompressor = zstandard.ZstdDecompressor(max_window_size=LARGEST_CHUNK_BYTES)
    begin = 0
    try:
        with decompressor.stream_reader(frames, read_across_frames=True) as stream:
            for each in chunks:
                part = data[begin : begin + each.size].data
                # At once, as it is still in a processor's cache.
                if stream.readinto(part) != each.size or zlib.crc32(part) != each.crc:
                    return None
                begin += each.size
    except zstandard.ZstdError:
        return None
    return data
