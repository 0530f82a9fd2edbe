"""Recovery: whatever happens to a file's end or middle, all that is whole in it comes back."""

import io
import json
import os
import struct
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from mcap.reader import NonSeekingReader, SeekingReader, make_reader
from mcap.writer import CompressionType, IndexType, Writer

from hilctl.base.errors import DataError, HilctlError
from hilctl.recording.reader import read
from hilctl.recording.recover import Rewritten, Survey, recover_recording
from hilctl.recording.recovery_scan import RecoveryScan
from hilctl.recording.run_summary import read_ends
from tests.commands import ended
from tests.unit.recording.conftest import written

PEERS = Path(__file__).parents[2] / "peers"
CHUNK, CHUNK_INDEX, STATISTICS, METADATA, DATA_END = 0x06, 0x08, 0x0B, 0x0C, 0x0F


def framed(data):
    """Opcode, start and end of every record, by nothing but the framing."""
    at, found = 8, []
    while at < len(data) - 8:
        opcode, length = struct.unpack_from("<BQ", data, at)
        found.append((opcode, at, at + 9 + length))
        at += 9 + length
    return found


def messages(stream, kind=SeekingReader):
    """Topic, number, time and bytes of every message in file order, by the stock reader."""
    reader = kind(stream, validate_crcs=True)
    return [
        (channel.topic, message.sequence, message.log_time, message.data)
        for _, channel, message in reader.iter_messages(log_time_order=False)
    ]


def chunk_sizes(data):
    """How many messages each chunk of a sound file holds."""
    reader = SeekingReader(io.BytesIO(data))
    sizes = []
    for chunk in reader.get_summary().chunk_indexes:
        at = chunk.chunk_start_offset + chunk.chunk_length
        size, end = 0, at + chunk.message_index_length
        while at < end:
            length, _, entries = struct.unpack_from("<QHI", data, at + 1)
            size += entries // 16
            at += 9 + length
        sizes.append(size)
    return sizes


@pytest.fixture(scope="module")
def sound(make):
    """A finished recording: its bytes, records, messages, and messages whole at each offset."""
    batches = [make.batch(0, 4), make.batch(200, 20, seed=1)]
    batches += [make.batch(1400, 3, dropped=200, seed=2), make.batch(1550, 90, seed=3)]
    stream = io.BytesIO()
    make.write(stream, batches)
    data = stream.getvalue()
    sizes = iter(np.cumsum(chunk_sizes(data)).tolist())
    whole = [(end, next(sizes)) for opcode, _, end in framed(data) if opcode == CHUNK]
    return SimpleNamespace(
        data=data,
        records=framed(data),
        messages=messages(io.BytesIO(data)),
        before=lambda cut: max((count for end, count in whole if end <= cut), default=0),
        begun=lambda cut: cut >= next(end for code, _, end in framed(data) if code == METADATA),
    )


def check(path, sound, cut):
    """Recover a file cut at an offset; return how many of the sound file's messages are back."""
    torn = path.read_bytes()
    recovered = recover_recording(path)
    assert recovered.original.read_bytes() == torn
    with path.open("rb") as stream:
        back = messages(stream)
    with path.open("rb") as stream:
        assert messages(stream, NonSeekingReader) == back
    with path.open("rb") as stream:
        reader = SeekingReader(stream, validate_crcs=True)
        summary = reader.get_summary()
        end = {record.name: record.metadata for record in reader.iter_metadata()}["hilctl.end"]
        attachments = [record.name for record in reader.iter_attachments()]
    assert summary.statistics.message_count == len(back)
    assert summary.statistics.metadata_count == 2
    named = ["experiment.yaml", "model.yaml", "device/profile.yaml"]
    assert attachments == named[: len(attachments)]
    assert back[-1][0] == "/events"
    assert back[:-1] == sound.messages[: len(back) - 1]
    assert len(back) - 1 >= sound.before(cut)
    assert end["recovered"] in recovered.reason
    assert int(end["recorded_samples"]) == recovered.samples == read(path).samples.index.size
    path.unlink()
    recovered.original.unlink()
    return len(back) - 1


def boundaries(sound):
    """Every record's start, its frame's middle, its body's start, middle and last byte."""
    last = len(sound.data) - 1
    offsets = {last, last - 4, last - 8}
    for _, start, end in sound.records:
        offsets |= {start, start + 1, start + 5, start + 9, (start + end) // 2, end - 1}
    return sorted(offset for offset in offsets if offset <= last)


@pytest.mark.slow
def test_cut_at_every_kind_of_boundary(sound, tmp_path):
    path = tmp_path / "run.mcap"
    counts = set()
    for cut in boundaries(sound):
        path.write_bytes(sound.data[:cut])
        if sound.begun(cut):
            counts.add(check(path, sound, cut))
        else:
            with pytest.raises(DataError, match="nothing"):
                recover_recording(path)
            assert path.read_bytes() == sound.data[:cut]
    assert {sound.before(cut) for cut in boundaries(sound)} <= counts


def test_flipped_bits_are_detected(sound):
    rng = np.random.default_rng(3)
    places = set(rng.integers(0, len(sound.data), 60).tolist())
    for opcode, start, end in sound.records:
        places |= {start, start + 5, end - 1}
        if opcode == METADATA:
            places |= set(range(start, end, 37))
    for at in sorted(places):
        damaged = bytearray(sound.data)
        damaged[at] ^= 1 << int(rng.integers(8))
        try:
            survey = Survey(io.BytesIO(damaged))
        except DataError:
            continue
        assert not survey.scan.sound, at


@pytest.mark.parametrize("name", ["hilctl.run", "hilctl.end"])
def test_flipped_bit_in_the_facts_is_reported_by_all_readers(sound, tmp_path, caplog, name):
    facts = [start for opcode, start, _ in sound.records if opcode == METADATA]
    text, start = (b"200.0", facts[0]) if name == "hilctl.run" else (b"completed", facts[1])
    at = sound.data.index(text, start)
    path = tmp_path / "run.mcap"
    path.write_bytes(sound.data[:at] + b"4" + sound.data[at + 1 :])
    for _ in range(2):
        read(path)
        assert f"metadata {name} " in caplog.text
        caplog.clear()
        ends = read_ends(path)
        assert ends.state == "damaged"
        assert name in ends.problem
        assert name == "hilctl.end" or not ends.run
        assert ends.end == {}
        recovered = recover_recording(path)
        assert not recovered.sound
    assert recovered.original is None  # the second time there is nothing to repair
    assert len(list(tmp_path.iterdir())) == 2


def test_flipped_bit_outside_the_chunks_is_detected(sound, tmp_path, caplog):
    start = [start for opcode, start, _ in sound.records if opcode == CHUNK][-1]
    damaged = bytearray(sound.data)
    damaged[start + 9] ^= 1
    path = tmp_path / "run.mcap"
    path.write_bytes(damaged)
    read(path)
    assert "wrong checksum" in caplog.text
    assert not recover_recording(path).sound
    assert recover_recording(path).sound


def test_file_without_checksums_is_intact(sound, tmp_path):
    """0 means that there is none: so older recordings have it."""
    (end,) = [start for opcode, start, _ in sound.records if opcode == DATA_END]
    path = tmp_path / "run.mcap"
    path.write_bytes(sound.data[: end + 9] + bytes(4) + sound.data[end + 13 :])
    assert recover_recording(path).sound


@pytest.mark.slow
def test_random_cuts_garbage_and_zeros(sound, tmp_path):
    """At 100 random places, with nothing, zeros or garbage behind the cut: what is saved is right.

    Garbage may save more than nothing: it fills up a block that begins right.
    """
    rng = np.random.default_rng(7)
    path = tmp_path / "run.mcap"
    first = next(end for code, _, end in sound.records if code == METADATA)
    for number, cut in enumerate(rng.integers(first, len(sound.data), 100).tolist()):
        path.write_bytes(sound.data[:cut])
        check(path, sound, cut)
        behind = int(rng.integers(1, 9000))
        path.write_bytes(sound.data[:cut] + (bytes(behind) if number % 2 else rng.bytes(behind)))
        check(path, sound, cut)


def test_messages_of_a_truncated_chunk_are_recovered(sound, tmp_path):
    last = [(start, end) for code, start, end in sound.records if code == CHUNK][3]
    cut = last[1] - 1000
    path = tmp_path / "run.mcap"
    path.write_bytes(sound.data[:cut])
    recovered = recover_recording(path)
    (damage,) = recovered.damages
    assert (damage.what, damage.start, damage.size) == ("torn chunk", last[0], cut - last[0])
    assert damage.saved >= 2
    assert f"{damage.saved} messages of it" in recovered.reason
    assert "unknown" in recovered.reason


@pytest.mark.parametrize("kind", [CompressionType.NONE, CompressionType.LZ4])
def test_other_compressions(sound, make, tmp_path, kind, monkeypatch):
    import hilctl.recording.writer as module

    stream = io.BytesIO()
    monkeypatch.setattr(module, "mcap_writer", partial(Writer, compression=kind))
    make.write(stream, [make.batch(0, 4), make.batch(200, 240, seed=1)])
    data = stream.getvalue()
    every = messages(io.BytesIO(data))
    _, start, end = [record for record in framed(data) if record[0] == CHUNK][1]
    path = tmp_path / "run.mcap"
    for cut in range(start + 60, end, (end - start) // 9):
        path.write_bytes(data[:cut])
        saved = recover_recording(path).damages[0].saved
        with path.open("rb") as stream:
            assert messages(stream)[:-1] == every[: saved + chunk_sizes(data)[0]]
        inside = data[start + 49 : cut].rstrip(b"\0")
        if kind is CompressionType.NONE:
            assert saved == sum(record[3] in inside for record in every[chunk_sizes(data)[0] :])
        else:
            assert saved > 0 or cut < (start + end) // 2


@pytest.mark.parametrize("place", ["frame", "length", "head", "data", "index"])
@pytest.mark.parametrize("number", [0, 1, 3])
def test_flipped_bytes_in_a_chunk(sound, tmp_path, place, number):
    start, end = [(start, end) for code, start, end in sound.records if code == CHUNK][number]
    middle, behind = (start + end) // 2, end + 12
    at = {"frame": start, "length": start + 4, "head": start + 30, "data": middle, "index": behind}
    data = bytearray(sound.data)
    data[at[place]] ^= 0x10
    path = tmp_path / "run.mcap"
    path.write_bytes(data)
    recovered = recover_recording(path)
    counts = [0, *np.cumsum(chunk_sizes(sound.data)).tolist()]
    kept = list(sound.messages)
    if place in ("head", "data", "frame"):
        del kept[counts[number] : counts[number + 1]]
    with path.open("rb") as stream:
        assert messages(stream)[:-1] == kept
    back = read(path)
    assert back.end["code"] == "completed"
    lost = (200, 1000, 150, 4500)[number] if len(kept) < len(sound.messages) else 0
    assert recovered.missing_samples == back.dropped == 200 + lost
    assert ("is lost" in recovered.reason) is False


def test_damaged_facts_are_left_out(sound, tmp_path):
    data = bytearray(sound.data)
    data[8:300] = bytes(292)
    path = tmp_path / "run.mcap"
    path.write_bytes(data)
    recover_recording(path)
    with path.open("rb") as stream:
        assert messages(stream)[:-1] == sound.messages
    with pytest.raises(DataError, match=r"hilctl\.run "):
        read(path)


def test_a_file_cut_in_its_index_keeps_its_end(sound, tmp_path):
    path = tmp_path / "run.mcap"
    path.write_bytes(sound.data[:-60])
    recovered = recover_recording(path, end={"code": "fault", "reason": "it was not"})
    back = read(path)
    assert back.end["code"] == "completed"
    assert back.end["late_ticks"] == "3"
    assert (back.events[-1].code, back.events[0].code) == ("recovered", "run_ended")
    assert "its index" in recovered.reason
    assert "unknown" not in recovered.reason


def test_damaged_index_is_rebuilt(sound, tmp_path):
    path = tmp_path / "run.mcap"
    ended = next(end for code, _, end in sound.records if code == DATA_END)
    for _, start, end in sound.records:
        if start >= ended:
            data = bytearray(sound.data)
            data[(start + 9 + end) // 2] ^= 0x20
            path.write_bytes(data)
            assert check(path, sound, len(data)) == len(sound.messages)


@pytest.mark.parametrize(("opcode", "at"), [(STATISTICS, 9), (CHUNK_INDEX, 25)])
def test_an_index_without_a_checksum_must_fit(sound, tmp_path, opcode, at):
    path = tmp_path / "run.mcap"
    data = bytearray(sound.data)
    data[-12:-8] = bytes(4)
    path.write_bytes(data)
    assert recover_recording(path).sound
    start = next(start for code, start, _ in sound.records if code == opcode)
    data[start + at] ^= 1
    path.write_bytes(data)
    assert check(path, sound, len(data)) == len(sound.messages)


def test_missing_message_indexes_are_rebuilt(make, tmp_path, monkeypatch):
    import hilctl.recording.writer as module

    kinds = IndexType.ALL & ~IndexType.MESSAGE
    monkeypatch.setattr(module, "mcap_writer", partial(Writer, index_types=kinds))
    path = written(tmp_path / "run.mcap", [make.batch(0, 4), make.batch(200, 4)])
    assert not recover_recording(path).sound
    assert recover_recording(path).sound


@pytest.mark.parametrize("behind", [b"\0", bytes(5000), b"\x06garbage"])
def test_bytes_after_the_end_are_removed(sound, tmp_path, behind):
    path = tmp_path / "run.mcap"
    path.write_bytes(sound.data + behind)
    assert check(path, sound, len(sound.data)) == len(sound.messages)


def refusal(what, path):
    try:
        what(path)
    except HilctlError as error:
        return str(error)
    return ""


@given(st.data())
def test_any_damage_raises_only_known_errors(sound, tmp_path_factory, data):
    torn = bytearray(sound.data[: data.draw(st.integers(0, len(sound.data)))])
    for _ in range(data.draw(st.integers(0, 3)) if torn else 0):
        torn[data.draw(st.integers(0, len(torn) - 1))] = data.draw(st.integers(0, 255))
    path = tmp_path_factory.mktemp("any") / "run.mcap"
    path.write_bytes(torn)
    for what in (read, recover_recording, read):
        assert str(path) in (refusal(what, path) or str(path))


def test_other_readers_agree(sound, tmp_path):
    if not (PEERS / "node_modules" / "@mcap" / "core").is_dir():
        missing = "tests/peers/node_modules is not there: run npm ci in tests/peers"
        assert not os.environ.get("CI"), missing
        pytest.skip(missing)
    rng = np.random.default_rng(3)
    expected = {}
    for number, cut in enumerate([c for c in boundaries(sound) if sound.begun(c)][::3]):
        path = tmp_path / f"{number}.mcap"
        path.write_bytes(sound.data[:cut] + [b"", bytes(5000), rng.bytes(5000)][number % 3])
        recover_recording(path)
        with path.open("rb") as stream:
            counts = {}
            for topic, *_ in messages(stream):
                counts[topic] = counts.get(topic, 0) + 1
        expected[str(path)] = counts
    told = ended(["node", PEERS / "read_mcap.mjs", "-"], input="\n".join(expected))
    found = json.loads(told.stdout)
    assert {path: each["streamed"]["counts"] for path, each in found.items()} == expected
    for path, each in found.items():
        assert each["streamed"]["done"], path
        assert each["indexed"]["counts"] == expected[path]
        assert each["indexed"]["counted"] == sum(expected[path].values())
        assert "recovered" in each["indexed"]["metadata"]["hilctl.end"]


@pytest.fixture
def torn(make):
    """A recording of 400 samples, cut behind its last chunk."""
    stream = io.BytesIO()
    make.write(stream, [make.batch(0, 8)], finish=False)
    return stream


def resaved(survey, **finish):
    out = io.BytesIO()
    saved = Rewritten(out, survey)
    saved.copy(RecoveryScan(survey.scan._stream).records())
    reason = saved.finish(**{"end": None, "ended_at": 0, **finish})
    facts = {m.name: m.metadata for m in make_reader(io.BytesIO(out.getvalue())).iter_metadata()}
    return saved, reason, facts["hilctl.end"]


def test_survey_counts_intact_records(torn):
    survey = Survey(torn)
    assert (survey.samples, survey.next_sample) == (400, 400)
    assert survey.run["compensator"] == "rdpi"
    assert survey.end == {}
    assert not survey.scan.sound


FAULT = {"code": "fault", "reason": "x"}


@pytest.mark.parametrize(("finish", "missing", "code", "words"), [
    ({}, 0, "recovered", "last unflushed interval"),
    ({"end": FAULT, "ended_at": 450}, 50, "fault", "50 samples known"),
    ({"ended_at": 400}, 0, "recovered", "no sample is lost"),
])  # fmt: skip
def test_missing_and_unknown_samples_are_reported(torn, finish, missing, code, words):
    saved, reason, end = resaved(Survey(torn), **finish)
    assert words in reason
    assert saved.missing == int(end["missing_samples"]) == missing
    assert (end["code"], end["recorded_samples"]) == (code, "400")
