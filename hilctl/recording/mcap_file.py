"""An MCAP file in the making: chunks of messages, then an index of them.

Byte for byte what the ``mcap`` package writes, whose classes it takes for all that is rare. Of what
is not, messages, that package makes several Python objects each, and keeps an object with a
dictionary for every chunk until the end of the run.
"""

import struct
import zlib
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping
from typing import Protocol, TypeAlias

import numpy as np
import zstandard
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import (
    Attachment,
    AttachmentIndex,
    Channel,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    McapRecord,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
    SummaryOffset,
)
from mcap.writer import MCAP0_MAGIC

from hilctl.base.types import I64
from hilctl.recording.records import FRAME
from hilctl.recording.rows import MessageRows

Compression: TypeAlias = zstandard.ZstdCompressionParameters

CHUNK_BYTES = 5 << 20
"""A chunk is closed once it holds more than this: more than the 2 s at 50 kHz that are flushed
together, since every chunk learns anew what repeats."""
SAMPLES = Compression(compression_level=1, window_log=21, hash_log=15, target_length=1)
"""Compression that suits samples: higher levels take twice the time for noise and save a few
percent. Other than at that level, a table twice as large finds the same cycle again, and numbers of
eight bytes that are new are stepped over: of sines of 10 and 250 Hz and of a random reference, 17,
2 and 27 % less time, and 14, 9 and 1 % less to write. A window of 2 MiB instead of 512 KiB takes no
time, and saves another 10, 6 and 2 %."""

_MESSAGE = struct.Struct("<BQHIQQ")
_MESSAGE_ROW = np.dtype([("opcode", "u1"), ("size", "<u8"), ("channel", "<u2"),
                         ("sequence", "<u4"), ("logged", "<u8"), ("published", "<u8")])  # fmt: skip
_FIXED = _MESSAGE.size - FRAME.size
"""Bytes of a message record that are neither its opcode and size nor its data."""
_ZSTD = b"zstd"
_CHUNK = struct.Struct(f"<BQQQQII{len(_ZSTD)}sQ")
_INDEX = struct.Struct("<BQHI")
_INDEX_ROW = struct.Struct("<QQ")
_FOOTER = struct.Struct("<BQQQ")
_FOOTER_BYTES = 8 + 8 + 4
_PACKED_BYTES = 1 << 16
_FIRST_ROOM_BYTES = CHUNK_BYTES + (1 << 20)


class Sink(Protocol):
    """A binary file that a recording is written to."""

    def write(self, data: bytes | bytearray | memoryview, /) -> int:
        """Append bytes; return how many."""

    def tell(self) -> int:
        """Return the size so far."""

    def flush(self) -> None:
        """Hand what was written to the kernel."""


class McapWriter:
    """Writes one file.

    Args:
        stream: Open binary file; the writer does not close it.
        chunk_bytes: A chunk is closed once it holds more than this.
        compression: How chunks are compressed.
    """

    def __init__(
        self,
        stream: Sink,
        *,
        chunk_bytes: int = CHUNK_BYTES,
        compression: Compression = SAMPLES,
    ) -> None:
        self._stream = stream
        self._data_crc = 0
        self._chunk_bytes = chunk_bytes
        self._compressor = zstandard.ZstdCompressor(compression_params=compression)
        self._room = _Room()
        self._chunk = _OpenChunk(self._room)
        self._schemas: list[Schema] = []
        self._channels: list[Channel] = []
        self._attachments: list[AttachmentIndex] = []
        self._metadata: list[MetadataIndex] = []
        self._chunk_indexes = _PackedRecords()
        self._statistics = Statistics(
            attachment_count=0, channel_count=0, channel_message_counts=defaultdict(int),
            chunk_count=0, message_count=0, message_end_time=0, message_start_time=0,
            metadata_count=0, schema_count=0,
        )  # fmt: skip

    def start(self, profile: str, library: str) -> None:
        """Write the head of the file."""
        self._put(MCAP0_MAGIC)
        self._put(_bytes(Header(profile, library)))

    def _put(self, part: bytes | bytearray) -> None:
        """Write bytes of the data section."""
        self._stream.write(part)
        self._data_crc = zlib.crc32(part, self._data_crc)

    def register_schema(self, name: str, encoding: str, data: bytes) -> int:
        """Enter a schema; return its number."""
        schema = Schema(id=len(self._schemas) + 1, data=data, encoding=encoding, name=name)
        self._schemas.append(schema)
        self._statistics.schema_count += 1
        self._chunk.add(_bytes(schema))
        return schema.id

    def register_channel(
        self, topic: str, encoding: str, schema: int, metadata: Mapping[str, str] | None = None
    ) -> int:
        """Enter a channel; return its number."""
        channel = Channel(
            id=len(self._channels) + 1, topic=topic, message_encoding=encoding, schema_id=schema,
            metadata=dict(metadata or {}),
        )  # fmt: skip
        self._channels.append(channel)
        self._statistics.channel_count += 1
        self._chunk.add(_bytes(channel))
        return channel.id

    def add_attachment(
        self, created_ns: int, logged_ns: int, name: str, media_type: str, data: bytes
    ) -> None:
        """Write an attachment."""
        record = Attachment(created_ns, logged_ns, name, media_type, data)
        written = _bytes(record)
        index = AttachmentIndex(
            offset=self._stream.tell(), length=len(written), create_time=created_ns,
            log_time=logged_ns, data_size=len(data), name=name, media_type=media_type,
        )  # fmt: skip
        self._attachments.append(index)
        self._statistics.attachment_count += 1
        self._put(written)

    def add_metadata(self, name: str, data: Mapping[str, str]) -> None:
        """Write metadata."""
        written = _bytes(Metadata(name=name, metadata=dict(data)))
        self._metadata.append(
            MetadataIndex(length=len(written), name=name, offset=self._stream.tell())
        )
        self._statistics.metadata_count += 1
        self._put(written)

    def add_message(
        self, channel: int, logged_ns: int, data: bytes, published_ns: int, sequence: int
    ) -> None:
        """Write one message; times are Unix times in ns."""
        head = _MESSAGE.pack(
            Opcode.MESSAGE, _FIXED + len(data), channel, sequence, logged_ns, published_ns
        )
        chunk = self._chunk
        chunk.index(channel, _INDEX_ROW.pack(logged_ns, chunk.size))
        chunk.add(head)
        chunk.add(data)
        self._close_full()

    def add_rows(self, channel: int, times_ns: I64, rows: MessageRows, sequence: int) -> None:
        """Write messages of one channel.

        Args:
            channel: Its number.
            times_ns: int64[n], Unix time at which each is logged and published, in ns.
            rows: The messages, n of them and one at least.
            sequence: Number of the first.
        """
        count, whole = times_ns.size, _MESSAGE.size + rows.sizes()
        heads = np.empty(count, dtype=_MESSAGE_ROW)
        heads["opcode"] = Opcode.MESSAGE
        heads["size"] = whole - FRAME.size
        heads["channel"] = channel
        heads["sequence"] = np.arange(sequence, sequence + count)
        heads["logged"] = heads["published"] = times_ns
        data = rows.behind(heads.view(np.uint8).reshape(count, -1))
        places = np.empty((count, 2), dtype="<u8")
        places[:, 0] = times_ns
        places[:, 1] = self._chunk.size + whole.cumsum() - whole
        self._chunk.index(channel, places.tobytes())
        self._chunk.add(data)
        self._close_full()

    def _close_full(self) -> None:
        if self._chunk.size > self._chunk_bytes:
            self._close_chunk()

    def flush(self) -> None:
        """Close the chunk in work and hand it to the kernel; one without a message stays open."""
        self._close_chunk()
        self._stream.flush()

    def _close_chunk(self) -> None:
        closing = self._chunk
        if not closing.indexes:
            return
        first_ns, last_ns = self._count(closing)
        data = self._room.filled(closing.size)
        compressed = self._compressor.compress(data)
        head = _CHUNK.pack(
            Opcode.CHUNK, _CHUNK.size - FRAME.size + len(compressed), first_ns, last_ns,
            len(data), zlib.crc32(data), len(_ZSTD), _ZSTD, len(compressed),
        )  # fmt: skip
        start, length = self._stream.tell(), len(head) + len(compressed)
        offsets, indexes = {}, bytearray()
        for channel, places in closing.indexes.items():
            offsets[channel] = start + length + len(indexes)
            size = _INDEX.size - FRAME.size + len(places)
            indexes += _INDEX.pack(Opcode.MESSAGE_INDEX, size, channel, len(places)) + places
        index = ChunkIndex(
            chunk_length=length, chunk_start_offset=start, compression=_ZSTD.decode(),
            compressed_size=len(compressed), message_end_time=last_ns,
            message_index_length=len(indexes), message_index_offsets=offsets,
            message_start_time=first_ns, uncompressed_size=len(data),
        )  # fmt: skip
        self._chunk = _OpenChunk(self._room)
        for part in (head, compressed, indexes):
            self._put(part)
        self._chunk_indexes.add(_bytes(index))

    def _count(self, closing: "_OpenChunk") -> tuple[int, int]:
        """Count the messages of a chunk; return the first and the last of their times in ns."""
        found = self._statistics
        ends: list[int] = []
        for channel, places in closing.indexes.items():
            times_ns = np.frombuffer(places, "<u8")[::2]
            ends += int(times_ns.min()), int(times_ns.max())
            found.channel_message_counts[channel] += times_ns.size
            found.message_count += times_ns.size
        first_ns, last_ns = min(ends), max(ends)
        earlier_ns = found.message_start_time if found.chunk_count else first_ns
        found.message_start_time = min(earlier_ns, first_ns)
        found.message_end_time = max(found.message_end_time, last_ns)
        found.chunk_count += 1
        return first_ns, last_ns

    def finish(self) -> None:
        """Close the chunk in work, and write index and foot of the file."""
        self._close_chunk()
        self._stream.write(_bytes(DataEnd(self._data_crc)))
        start = end = self._stream.tell()
        crc, offsets = 0, bytearray()
        groups: tuple[tuple[int, Iterable[bytes]], ...] = (
            (Opcode.SCHEMA, map(_bytes, self._schemas)),
            (Opcode.CHANNEL, map(_bytes, self._channels)),
            (Opcode.STATISTICS, [_bytes(self._statistics)]),
            (Opcode.CHUNK_INDEX, self._chunk_indexes),
            (Opcode.ATTACHMENT_INDEX, map(_bytes, self._attachments)),
            (Opcode.METADATA_INDEX, map(_bytes, self._metadata)),
        )
        for opcode, parts in groups:
            began = end
            for part in parts:
                self._stream.write(part)
                crc, end = zlib.crc32(part, crc), end + len(part)
            offsets += _bytes(SummaryOffset(opcode, began, end - began))
        self._stream.write(offsets)
        head = _FOOTER.pack(Opcode.FOOTER, _FOOTER_BYTES, start, end)
        crc = zlib.crc32(head, zlib.crc32(offsets, crc))
        self._stream.write(_bytes(Footer(start, end, crc)))
        self._stream.write(MCAP0_MAGIC)


class _PackedRecords:
    """Records that nobody reads until the end, packed: of ten chunks a second 1 MB an hour."""

    def __init__(self) -> None:
        self._packed: list[bytes] = []
        self._newest = bytearray()

    def add(self, record: bytes) -> None:
        self._newest += record
        if len(self._newest) > _PACKED_BYTES:
            self._packed.append(zlib.compress(self._newest, 1))
            self._newest = bytearray()

    def __iter__(self) -> Iterator[bytes]:
        yield from map(zlib.decompress, self._packed)
        yield bytes(self._newest)


class _Room:
    """Where one chunk after the other is put together; memory is got once, for the longest."""

    def __init__(self) -> None:
        # Not a bytearray: filled with zeros, it would take memory that short chunks leave alone.
        self._bytes = np.empty(_FIRST_ROOM_BYTES, dtype=np.uint8).data

    def put(self, at: int, part: bytes) -> None:
        """Put bytes where those before end."""
        end = at + len(part)
        if end > len(self._bytes):
            larger = np.empty(max(end, 2 * len(self._bytes)), dtype=np.uint8).data
            larger[:at] = self._bytes[:at]
            self._bytes = larger
        self._bytes[at:end] = part

    def filled(self, size: int) -> memoryview:
        """Return what was put, up to a size; it is changed by what is put next."""
        return self._bytes[:size]


class _OpenChunk:
    """The chunk in work."""

    def __init__(self, room: _Room) -> None:
        self._room = room
        self.size = 0
        self.indexes: dict[int, bytearray] = {}
        """Time and place of each message, by channel."""

    def add(self, part: bytes) -> None:
        self._room.put(self.size, part)
        self.size += len(part)

    def index(self, channel: int, places: bytes) -> None:
        """Enter messages that are added next, by their times and places."""
        self.indexes.setdefault(channel, bytearray()).extend(places)


def _bytes(record: McapRecord) -> bytes:
    """Return a record as it stands in a file."""
    builder = RecordBuilder()
    record.write(builder)
    found: bytes = builder.end()
    return found
