"""Scan of an MCAP file, intact or not, for all valid records and the rest of damaged chunks.

A chunk is valid by its checksum, any other record by its lengths. After damage the scan continues
at the next probable chunk, metadata, attachment or end of data. From a chunk at the truncated end
of a file, as many messages as possible are read; without a checksum, each must decode. A damaged
chunk elsewhere is omitted, because any number in it may be wrong.
"""

import re
import zlib
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import cache
from typing import BinaryIO, NamedTuple

from mcap.opcode import Opcode
from mcap.records import (
    Channel,
    Chunk,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    McapRecord,
    Message,
    Metadata,
    Schema,
    Statistics,
)
from mcap.writer import MCAP0_MAGIC as MAGIC

from hilctl.recording import schema
from hilctl.recording.mcap_records import (
    CHUNK_HEAD,
    FRAME,
    LARGEST_BYTES,
    LARGEST_CHUNK_BYTES,
    LENGTH,
    Contents,
    ReadBudget,
    contents,
    inflate,
    parse,
    split,
)
from hilctl.recording.metadata_keys import AXIS_FACT, unsealed
from hilctl.recording.validation import MessageValidator, block_problem, decode

_WINDOW_BYTES = 4 * 2**20
_IN_CHUNKS = {Opcode.SCHEMA, Opcode.CHANNEL, Opcode.MESSAGE}
# Lengths are little-endian and far below 2**40: their three highest bytes are 0.
_LIKELY = re.compile(
    rb"\x06.{5}\0{3}.{16}.{5}\0{3}.{4}(?:\x04\0{3}zstd|\x03\0{3}lz4|\0{4}).{5}\0{3}"
    rb"|\x0c.{5}\0{3}.\0{3}hilctl\."
    rb"|\x09.{5}\0{3}.{16}.\0{3}(?:experiment|model|correction)\.yaml"
    rb"|\x0f\x04\0{7}.{4}[\x02\x03\x04\x0b]",
    re.DOTALL,
)
_LIKELY_BYTES = 64
_SECTOR = bytes(512)


def next_likely(stream: BinaryIO, at: int, size: int) -> int:
    """Return the offset of the next probable record from ``at`` on, or ``size``."""
    window = _LIKELY_BYTES  # small at first, so that a file full of candidates is read once
    while at < size:
        stream.seek(at)
        found = _LIKELY.search(stream.read(window + _LIKELY_BYTES))
        if found:
            return at + found.start()
        at += window
        window = min(2 * window, _WINDOW_BYTES)
    return size


def tail_kind(stream: BinaryIO, at: int, size: int) -> str:
    """Return the kind of trailing bytes without records: ``zeros`` or ``unreadable bytes``."""
    for start in range(at, size, _WINDOW_BYTES):
        stream.seek(start)
        if stream.read(_WINDOW_BYTES).strip(b"\0"):
            return "unreadable bytes"
    return "zeros"


def take_chunk(raw: bytes, budget: ReadBudget, *, last: bool) -> tuple[list[McapRecord], str]:
    """Return the readable records of an invalid chunk, and the kind of its damage."""
    chunk = _as_far_as_it_goes(raw)
    if chunk is None:
        return [], "torn chunk" if last else "damaged chunk"
    inside = contents(chunk, budget)
    if inside is not None:  # only its frame is damaged
        return list(inside.records), "index"
    if not last or not _is_cut(chunk, raw):
        return [], "damaged chunk"
    whole = _before_zeros(chunk)
    data = inflate(chunk.compression, whole, chunk.uncompressed_size, budget)
    return _believable(data), "torn chunk"


def _before_zeros(chunk: Chunk) -> bytes:
    """Return data up to the zeros of a power failure; values of 0.0 before them are lost too."""
    data = chunk.data
    if chunk.compression and _SECTOR in data:  # not valid in a compressed stream
        data = data[: data.index(_SECTOR)]
    return data.rstrip(b"\0")


def _as_far_as_it_goes(raw: bytes) -> Chunk | None:
    """Return a chunk from the length of its data, not of its record, cut at the end of ``raw``."""
    start = FRAME.size + CHUNK_HEAD.size
    if len(raw) < start:
        return None
    first, last, size, crc, name_length = CHUNK_HEAD.unpack_from(raw, FRAME.size)
    name = raw[start : start + name_length]
    begin = start + name_length + LENGTH.size
    if name not in {b"", b"lz4", b"zstd"} or len(raw) < begin or size > LARGEST_CHUNK_BYTES:
        return None
    (length,) = LENGTH.unpack_from(raw, begin - LENGTH.size)
    return Chunk(
        compression=name.decode(),
        data=raw[begin : begin + length],
        message_end_time=last,
        message_start_time=first,
        uncompressed_crc=crc,
        uncompressed_size=size,
    )


def _is_cut(chunk: Chunk, raw: bytes) -> bool:
    """Return whether a chunk is truncated by the end of the file or zeros, but not damaged."""
    length = FRAME.unpack_from(raw)[1]
    return len(raw) < FRAME.size + length or chunk.data.endswith(b"\0")


def _believable(data: bytes) -> list[McapRecord]:
    """Return records without a valid checksum, up to the first one that hilctl cannot have written.

    If invalid bytes follow instead of the start of another record, the last record may end with
    some of them and is omitted.
    """
    records: list[McapRecord] = []
    end = 0
    for _, stop, record in split(data):
        if isinstance(record, Message) and not _decodes(record):
            return records[:-1]
        records.append(record)
        end = stop
    rest = data[end:]
    if len(rest) >= FRAME.size:
        opcode, length = FRAME.unpack_from(rest)
        begun = opcode in _IN_CHUNKS and len(rest) - FRAME.size < length <= LARGEST_BYTES
        return records if begun else records[:-1]
    return records if not rest or rest[0] in _IN_CHUNKS else records[:-1]


def _decodes(message: Message) -> bool:
    own = own_channels().get(message.channel_id)
    if own is None:
        return False
    decoded, problem = decode(own[1].topic, message.data)
    if problem or own[1].topic != "/samples":
        return not problem
    return not block_problem(decoded, 0)


@cache
def own_channels(axis: str = "") -> dict[int, tuple[Schema, Channel]]:
    """Return schema and channel of each channel id of hilctl, in order."""
    descriptors = schema.descriptor_set()
    return {
        number: (
            Schema(number, descriptors, "protobuf", f"hilctl.{name}"),
            Channel(number, schema.topic_of(axis, topic), "protobuf", {}, number),
        )
        for number, (topic, name) in enumerate(schema.TOPICS.items(), start=1)
    }


_INDEX_KINDS = {Opcode.MESSAGE_INDEX, Opcode.DATA_END, Opcode.FOOTER}
_KNOWN = {opcode.value for opcode in Opcode}


@dataclass(frozen=True, slots=True)
class Damage:
    """A damaged range of a file.

    Attributes:
        start: Offset of its first byte.
        what: ``torn chunk``, ``damaged chunk``, ``damaged record``, ``index`` (no data of the run
            is lost), ``zeros``, ``unreadable bytes``, ``message of no channel``, ``data section
            with a wrong checksum`` (in a header or chunk time, if nothing else is damaged),
            ``metadata NAME with a wrong checksum``, or the problem of an invalid message.
        lasting: Whether rewriting the file does not repair it.
    """

    start: int
    size: int
    what: str
    saved: int = 0
    lasting: bool = False

    def __str__(self) -> str:
        saved = f", {self.saved} messages of it saved without a checksum" if self.saved else ""
        return f"{self.what} at byte {self.start} ({self.size} bytes{saved})"


class _Found(NamedTuple):
    """A valid record (None for a message index), its content if it is a chunk, and its end."""

    record: McapRecord | None
    inside: Contents | None
    end: int


class RecoveryScan:
    """Scan of a file; its attributes are final after :meth:`records` is exhausted.

    Args:
        sound: Validator whose invalid messages are omitted and noted as damage; None yields all.

    Attributes:
        finished: Whether footer and closing magic exist and the index matches the data.
        unread: Ids of channels whose messages are omitted from now on; these channels must have
            been yielded before.
    """

    def __init__(self, stream: BinaryIO, sound: MessageValidator | None = None) -> None:
        self._stream = stream
        self._sound = sound
        self.size = stream.seek(0, 2)
        self.budget = ReadBudget(self.size)
        self.is_mcap = self._read(0, len(MAGIC)) == MAGIC
        self.header: Header | None = None
        self.damages: list[Damage] = []
        self.finished = False
        self.unread: set[int] = set()
        self._data_ended = False
        self._crc = zlib.crc32(MAGIC)
        self._channels: set[int] = set()
        self._axis = ""
        self._indexes: dict[int, bytes] = {}
        self._chunks: list[int] = []
        self._indexed: list[int] = []
        self._messages = 0
        self._counted = -1

    @property
    def sound(self) -> bool:
        """Whether nothing is damaged or missing."""
        return self.finished and not self.damages

    @property
    def repairable(self) -> bool:
        """Whether rewriting the file repairs anything."""
        return not self.finished or not all(damage.lasting for damage in self.damages)

    def describe(self) -> str:
        """Describe the damage of the file in one line."""
        serious = [damage for damage in self.damages if damage.what != "index"]
        if not self.damages:
            return "its end and index are missing"
        if not serious:
            return "its index is damaged or truncated"
        more = f" and {len(serious) - 2} more" if len(serious) > 2 else ""
        wrong = "; any fact in it may be wrong" if any(each.lasting for each in serious) else ""
        return ", ".join(str(damage) for damage in serious[:2]) + more + wrong

    def records(self) -> Iterator[McapRecord]:
        """Yield header, metadata, attachments, schemas, channels and messages in order.

        Every message comes after its channel, and every channel after its schema.
        """
        at = len(MAGIC)
        if not self.is_mcap:
            at = next_likely(self._stream, 1, self.size)
            self._note(0, at, "damaged record")
        while at < self.size:
            found = self._whole(at)
            if found is None:
                after = next_likely(self._stream, at + 1, self.size)
                yield from self._with_channels(self._damaged(at, after), at)
                at = after
                continue
            yield from self._with_channels(self._take(at, found), at)
            if isinstance(found.record, Footer):
                self._close(at, found.end, found.record)
                return
            at = found.end

    def records_at(self, places: Iterable[int]) -> Iterator[McapRecord]:
        """Yield the records at offsets from the index of a finished file."""
        for at in places:
            self._indexes = {}  # message indexes are not read
            found = self._whole(at)
            if found is None:
                self._note(at, 0, "damaged record")
                continue
            yield from self._with_channels(self._take(at, found), at)
        self.finished = True

    def _read(self, at: int, size: int) -> bytes:
        self._stream.seek(at)
        found = self._stream.read(size)
        self.budget.read(len(found))
        return found

    def _whole(self, at: int) -> _Found | None:
        frame = self._read(at, FRAME.size)
        if len(frame) < FRAME.size:
            return None
        opcode, length = FRAME.unpack(frame)
        end = at + FRAME.size + length
        if opcode not in _KNOWN or length > LARGEST_BYTES or end > self.size:
            return None
        body = self._read(at + FRAME.size, length)
        if opcode != Opcode.DATA_END:  # its checksum covers everything before it
            self._crc = zlib.crc32(body, zlib.crc32(frame, self._crc))
        if opcode == Opcode.MESSAGE_INDEX:  # the content of its chunk determines every byte
            right = self._indexes.pop(int.from_bytes(body[:2], "little"), None)
            return _Found(None, None, end) if body == right else None
        record = parse(opcode, body)
        inside = None
        if isinstance(record, Chunk):
            inside = contents(record, self.budget, self.unread)
        if record is None or (isinstance(record, Chunk) and inside is None):
            return None
        return _Found(record, inside, end)

    def _take(self, at: int, found: _Found) -> list[McapRecord]:
        """Note a valid record; return its data records."""
        record = found.record
        if record is None:
            return []
        if self._indexes:  # some indexes of the previous chunk are missing
            self._note(at, at, "index")
            self._indexes = {}
        if found.inside is not None:
            self._chunks.append(at)
            self._indexes = dict(found.inside.indexes)
            self._messages += found.inside.unread
            self.budget.message(found.inside.unread)
            return list(found.inside.records)
        if self._data_ended or isinstance(record, DataEnd):
            self._data_ended = True
            match record:
                case DataEnd():
                    self._check_data(at, record)
                case Statistics():
                    self._counted = record.message_count
                case ChunkIndex():
                    self._indexed.append(record.chunk_start_offset)
            return []
        if isinstance(record, Header):
            self.header = record
        if isinstance(record, Metadata):
            self._check_facts(at, found.end, record)
        return [record]

    def _check_facts(self, at: int, end: int, record: Metadata) -> None:
        facts, right = unsealed(record.name, record.metadata)
        self._axis = facts.get(AXIS_FACT, self._axis)
        if not right:
            what = f"metadata {record.name} with a wrong checksum"
            self.damages.append(Damage(at, end - at, what, lasting=True))

    def _check_data(self, at: int, end: DataEnd) -> None:
        """Compare the checksum of the data section, if there is one."""
        explained = not all(damage.lasting for damage in self.damages)
        if end.data_section_crc and not explained and self._crc != end.data_section_crc:
            self._note(0, at, "data section with a wrong checksum")

    def _close(self, start: int, at: int, footer: Footer) -> None:
        """Check the footer from ``start`` and the bytes from ``at`` on."""
        begin = footer.summary_start
        summary = self._read(begin, start + FRAME.size + 16 - begin) if begin < start else b""
        right = footer.summary_crc in {0, zlib.crc32(summary)}
        fits = self._counted == self._messages and self._indexed == self._chunks
        end = at + len(MAGIC)
        self.finished = bool(begin) and right and fits and self._read(at, len(MAGIC)) == MAGIC
        if not self.finished:
            self._note(start, self.size, "index")
        elif end < self.size:
            self._note(end, self.size, tail_kind(self._stream, end, self.size))

    def _with_channels(self, records: list[McapRecord], at: int) -> Iterator[McapRecord]:
        """Yield records, with a channel of hilctl before a message whose channel is lost."""
        for record in records:
            if isinstance(record, Channel):
                self._channels.add(record.id)
            elif isinstance(record, Message):
                if record.channel_id not in self._channels:
                    yield from self._lost_channels()
                if record.channel_id not in self._channels:
                    self._note(at, 0, "message of no channel")
                    continue
                self._messages += 1
                self.budget.message()
            problem = self._sound.problem(record) if self._sound else ""
            if problem:
                self._note(at, 0, problem)
            else:
                yield record

    def _lost_channels(self) -> Iterator[McapRecord]:
        for number, pair in own_channels(self._axis).items():
            if number not in self._channels:
                self._channels.add(number)
                for record in pair:
                    if self._sound:
                        self._sound.problem(record)
                    yield record

    def _damaged(self, at: int, after: int) -> list[McapRecord]:
        """Note damage; return the records saved from it."""
        opcode, records = self._read(at, 1)[0], list[McapRecord]()
        if self._data_ended or opcode in _INDEX_KINDS:
            what = "index"
        elif opcode == Opcode.CHUNK:
            raw = self._read(at, min(after - at, LARGEST_BYTES))
            records, what = take_chunk(raw, self.budget, last=after == self.size)
        elif opcode in _KNOWN:
            what = "damaged record"
        else:
            what = tail_kind(self._stream, at, after)
        saved = sum(isinstance(record, Message) for record in records)
        self._note(at, after, what, saved)
        return records

    def _note(self, at: int, after: int, what: str, saved: int = 0) -> None:
        self.damages.append(Damage(at, max(0, after - at), what, saved))
