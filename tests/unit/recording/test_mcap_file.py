"""A file is, byte for byte, what the ``mcap`` package writes of the same."""

import io
from itertools import pairwise

import numpy as np
import pytest
from mcap.reader import make_reader

from hilctl.recording import mcap_file
from hilctl.recording.mcap_file import Compression, McapWriter
from hilctl.recording.rows import scope_rows
from tests.fakes import PackageMcapWriter

AS_THERE = Compression(compression_level=3)  # as that package has it
CHUNK = 600


def rows_of(first, count):
    index = np.arange(first, first + count)
    flags = np.zeros(count, dtype=np.uint32)
    return scope_rows(index, flags, {2: index * 0.5, 3: np.sin(index)})


def nothing(writer):
    writer.start("", "library")


def no_message(writer):
    """Schemas and channels without one are in the index alone."""
    writer.start("profile", "library")
    writer.register_channel("/a", "protobuf", writer.register_schema("A", "protobuf", b"xyz"))
    writer.flush()


def everything(writer):
    """Facts first, messages of two channels and out of order, rows, flushes, and facts last."""
    writer.start("", "hilctl 1.0")
    writer.add_metadata("hilctl.run", {"a": "1", "b": "µ"})
    writer.add_attachment(7, 8, "experiment.yaml", "application/yaml", b"name: x\n")
    schema = writer.register_schema("A", "protobuf", bytes(range(200)))
    one = writer.register_channel("/one", "protobuf", schema)
    two = writer.register_channel("/two", "protobuf", schema, {"unit": "um"})
    writer.flush()
    times = iter([50, 20, 90, 91, 10, 300, 301, 5])
    for number, time_ns in enumerate(times):
        writer.add_message(two if number % 3 else one, time_ns, b"m" * 40 * number, time_ns, number)
        if number == 2:
            writer.flush()
            writer.flush()
    writer.add_rows(one, np.array([400, 399, 405]), rows_of(126, 3), 3)
    writer.flush()
    for first in range(0, 200, 5):
        writer.add_rows(two, 1000 + np.arange(first, first + 5), rows_of(first, 5), first)
        writer.add_message(one, 1000 + first, b"tick", 990 + first, first)
        if not first % 10:
            writer.flush()
    writer.add_metadata("hilctl.end", {"code": "completed"})


def many_chunks(writer):
    """Chunks that are closed because they are full."""
    writer.start("", "library")
    channel = writer.register_channel("/a", "protobuf", 0)
    for number in range(300):
        writer.add_message(channel, number, bytes([number % 251]) * (number % 97), number, number)


@pytest.mark.parametrize("write", [nothing, no_message, everything, many_chunks])
def test_it_is_what_the_package_writes(write, monkeypatch):
    monkeypatch.setattr(mcap_file, "_PACKED_BYTES", 500)  # a few chunks' indexes
    ours, theirs = io.BytesIO(), io.BytesIO()
    for stream, writer in (
        (ours, McapWriter(ours, chunk_bytes=CHUNK, compression=AS_THERE)),
        (theirs, PackageMcapWriter(theirs, chunk_size=CHUNK)),
    ):
        write(writer)
        before = stream.getvalue()
        writer.finish()
        assert stream.getvalue().startswith(before)
    assert ours.getvalue() == theirs.getvalue()


def test_rows_close_a_chunk_that_is_full():
    """Not within them: one chunk may be as much longer as one batch is."""
    stream = io.BytesIO()
    writer = McapWriter(stream, chunk_bytes=CHUNK)
    writer.start("", "library")
    channel = writer.register_channel("/a", "protobuf", 0)
    for first in range(0, 100, 20):
        writer.add_rows(channel, np.arange(first, first + 20), rows_of(first, 20), first)
    writer.finish()
    stream.seek(0)
    reader = make_reader(stream, validate_crcs=True)
    summary = reader.get_summary()
    assert [each.message_start_time for each in summary.chunk_indexes] == [0, 20, 40, 60, 80]
    messages = [message for _, _, message in reader.iter_messages()]
    assert [message.sequence for message in messages] == list(range(100))
    assert all(a.log_time < b.log_time for a, b in pairwise(messages))
