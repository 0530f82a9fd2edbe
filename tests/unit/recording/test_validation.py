"""Rules for facts and messages of recordings; violations are refused with one message."""

import io
import json
import struct

import pytest
import zstandard
from mcap.records import Attachment, Channel, Message, Metadata, Schema
from mcap.writer import Writer

from hilctl.base.errors import DataError, InputError
from hilctl.base.events import INVERSE, TUNED, Event
from hilctl.base.samples import BlockHeader
from hilctl.base.segments import Segment
from hilctl.recording import schema, validation
from hilctl.recording.encoder import RecordingLayout
from hilctl.recording.metadata_keys import sealed, unsealed
from hilctl.recording.reader import read
from hilctl.recording.recover import recover_recording
from hilctl.recording.recovery_scan import RecoveryScan
from tests.unit.recording.conftest import written

NO_SLOPE = {"share": 0.0, "samples": 10.0, "at_zero": 0.0}
FADE = NO_SLOPE | {"slope": 0.1}


@pytest.fixture
def crafted(tmp_path, make):
    """Write a recording whose records are changed by a function, with correct checksums."""

    def write(change):
        sound = io.BytesIO()
        make.write(sound, [make.batch(0, 4), make.batch(200, 4, seed=1)], events=[make.ended])
        stream = io.BytesIO()
        writer = Writer(stream)
        writer.start("", "")
        topics = {}
        for record in RecoveryScan(sound).records():
            if isinstance(record, Channel):
                topics[record.id] = record.topic
            if isinstance(record, Message):
                topic = topics[record.channel_id]
                decoded = schema.message_class(schema.TOPICS[topic])()
                decoded.ParseFromString(record.data)
                change(topic, decoded)
                data, times = decoded.SerializeToString(), (record.log_time, record.publish_time)
                writer.add_message(record.channel_id, times[0], data, times[1])
            else:
                _copy(writer, record, change)
        writer.finish()
        path = tmp_path / "crafted.mcap"
        path.write_bytes(stream.getvalue())
        return path

    return write


def _copy(writer, record, change):
    match record:
        case Schema():
            change("schema", record)
            writer.register_schema(record.name, record.encoding, record.data)
        case Channel():
            writer.register_channel(record.topic, record.message_encoding, record.schema_id)
        case Metadata():
            facts, _ = unsealed(record.name, record.metadata)
            change(record.name, facts)
            writer.add_metadata(record.name, sealed(record.name, facts))
        case Attachment():
            writer.add_attachment(0, 0, record.name, record.media_type, record.data)


def _set(topic, **fields):
    def change(where, decoded):
        if where == topic:
            for name, value in fields.items():
                if isinstance(value, list):
                    getattr(decoded, name)[:] = value
                else:
                    setattr(decoded, name, value)

    return change


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        (_set("/samples", n=2**32 - 1), "4294967295 samples with"),
        (_set("/samples", n=0), "holds no sample"),
        (_set("/samples", wanted_a=[1.0]), "200 samples with 1 of wanted_a"),
        (_set("/samples", current_a=[]), "200 samples with 0 of current_a or drive_v"),
        (_set("/samples", flags=[0]), "200 samples with 1 of flags"),
        (_set("/samples", measured_a=[0.0] * 3), "200 samples with 3 of measured_a"),
        (_set("/samples", tick0=2**64 - 1), "cannot follow sample -1"),
        (_set("/samples", tick0=7), "sample 7 cannot follow sample 206"),
        (_set("/samples", previous_command=[float("nan")]), "must be one finite number"),
        (_set("/samples", previous_command=[1.0, 2.0]), "must be one finite number"),
        (_set("/ticks", late_ns=[1]), "its columns differ in length"),
        (_set("/ticks", first_sample=[2**64 - 1] * 4), "is beyond any run"),
        (_set("/ticks", deadline_ns=[-(2**63)] * 4), f"deadline_ns of {2**63} ns"),
        (_set("/events", values=[1.0]), "0 names for 1 values"),
        (_set("/events", sample=2**63), "a sample is beyond any run"),
        (_set("/events", before_sample=[1]), "1 samples before it with 0 of before_flags"),
        (
            _set("/events", code=TUNED, value_names=["samples"], values=[float("inf")]),
            "a change of the reference by",
        ),
        *(
            (_set("/events", code=INVERSE, value_names=[*wrong], values=[*wrong.values()]),
             "a change of the inverse by")
            for wrong in (FADE | {"share": 1.5}, FADE | {"samples": 0.0}, NO_SLOPE)
        ),
    ],
)  # fmt: skip
def test_messages_that_hilctl_never_writes_are_refused(crafted, tmp_path, change, problem):
    path = crafted(change)
    with pytest.raises(DataError, match=problem) as caught:
        read(path)
    assert str(caught.value).startswith(f"{path}: /")
    assert "\n" not in str(caught.value)
    recovered = recover_recording(path, output=tmp_path / "sound.mcap")
    assert not recovered.sound
    assert read(recovered.path).samples.index.size == recovered.samples


@pytest.mark.parametrize(("facts", "problem"), [
    ({"sample_rate_hz": "nan"}, "sample_rate_hz must be a number from"),
    ({"sample_rate_hz": "1e999"}, "sample_rate_hz must be a number from"),
    ({"sample_rate_hz": "-5" + "0" * 5000}, "sample_rate_hz must be a number from"),
    ({"command_unit": "\x1b[31m"}, r"command_unit must be A or V, got '\\x1b\[31m'"),
    ({"command_unit": "V"}, "0 values of wanted_v for 400 samples"),
    ({"segments": "[" * 50_000}, "segments|nested"),
])  # fmt: skip
def test_invalid_facts_are_refused(crafted, facts, problem):
    path = crafted(lambda where, data: data.update(facts) if where == "hilctl.run" else None)
    with pytest.raises(DataError, match=problem):
        read(path)


@pytest.mark.parametrize("count", ["-1", "9" * 5000, "1e3", "٣"])
def test_invalid_counts_are_refused(crafted, count):
    change = {"missing_samples": count}
    path = crafted(lambda where, data: data.update(change) if where == "hilctl.end" else None)
    with pytest.raises(DataError, match="missing_samples"):
        read(path)
    assert recover_recording(path).sound


def test_a_topic_with_another_schema_is_refused(crafted, tmp_path):
    def change(where, record):
        if where == "schema" and record.name == "hilctl.SampleBlock":
            record.name = "foxglove.Log"

    path = crafted(change)
    with pytest.raises(DataError, match=r"hilctl.SampleBlock"):
        read(path)
    recovered = recover_recording(path, output=tmp_path / "sound.mcap")
    assert recovered.samples == 0
    assert read(recovered.path).events


def test_numbers_in_facts_are_read():
    assert validation.number_of({"rate": "2.5"}, "rate", 0.0, 9.0) == 2.5
    assert validation.count_of({}, "missing_samples") == 0
    with pytest.raises(ValueError, match="rate is missing"):
        validation.number_of({}, "rate", 0.0, 9.0)


@pytest.mark.parametrize("seconds", [-1, 9_223_372_036, 2**40])
def test_impossible_start_times_are_refused(seconds):
    with pytest.raises(InputError, match="1970 and 2261"):
        RecordingLayout(1000.0, "A", False, 100.0, seconds * 10**9)


def _with_chunk(sound, say, real, times):
    body = zstandard.ZstdCompressor(level=1).compress(bytes(real))
    head = struct.pack("<QQQII", 0, 0, say, 0, 4) + b"zstd" + struct.pack("<Q", len(body))
    chunk = b"\x06" + struct.pack("<Q", len(head) + len(body)) + head + body
    at = sound.index(b"\x04\0\0\0zstd") - 37
    return sound[:at] + chunk * times + sound[at:]


@pytest.mark.parametrize(("say", "real"), [(2**40, 2**20), (2**20, 2**28), (2**25, 2**25)])
def test_compression_bombs_are_refused(tmp_path, make, say, real):
    stream = io.BytesIO()
    make.write(stream, [make.batch(0, 40)])
    path = tmp_path / "bomb.mcap"
    path.write_bytes(_with_chunk(stream.getvalue(), say, real, 1))
    assert read(path).samples.index.size == 2000
    path.write_bytes(_with_chunk(stream.getvalue(), 2**25, 2**25, 20))
    for refuse in (read, recover_recording):
        with pytest.raises(DataError, match="bytes uncompressed"):
            refuse(path)


def test_blocks_of_a_dead_process_are_validated(tmp_path, make):
    path = written(tmp_path / "run.mcap", [make.batch(0, 4)], finish=False)
    left = make.batch(200, 4)
    left.heads[0, BlockHeader.FIRST_SAMPLE] = -5
    left.heads[2, BlockHeader.FIRST_SAMPLE] = 2**62
    left.heads[3, BlockHeader.LATE_NS] = -(2**63)
    assert validation.sound_blocks(left).tolist() == [False, True, False, False]
    events = [Event(-1, "info", "x", "y"), Event(3, "info", "x", "y", time_ns=-9), make.ended]
    recovered = recover_recording(path, [left], events=events, ended_at=validation.LAST_SAMPLE + 5)
    back = read(recovered.path)
    assert back.samples.index.tolist() == [*range(200), *range(250, 300)]
    assert recovered.missing_samples == 50
    assert [event.code for event in back.events] == ["run_ended", "recovered"]


@pytest.mark.parametrize(
    "text", ["", "[]", "3", '{"a": true}', '{"a": null}', '{"a": {}}', '{"a": NaN}', "[" * 100_000]
)
def test_invalid_labels_are_refused(text):
    with pytest.raises(ValueError, match="labels must"):
        validation.labels_of({"labels": text})
    assert validation.labels_of({}) == {}  # as in older recordings


GOOD = Segment("sine", 0, 100, 10, 90, 20.0).to_mapping()


@pytest.mark.parametrize(
    "change",
    [
        {"start": -1}, {"stop": 2**63}, {"start": 1.5}, {"start": 95}, {"steady_stop": 101},
        {"period": -1.0}, {"period": 1e-300}, {"period": float("nan")}, {"label": 3}, {"more": 1},
        {"start": False},
    ],
)  # fmt: skip
def test_impossible_segments_are_refused(change):
    assert validation.segments_of(json.dumps([GOOD])) == (Segment(**GOOD),)
    with pytest.raises(ValueError, match="segments: "):
        validation.segments_of(json.dumps([{**GOOD, **change}]))


def test_tolerated_deviations_from_the_format():
    """A period may be omitted or a whole number, and a label may contain a tab."""
    odd = {**GOOD, "period": 20, "label": "sine\t"}
    assert validation.segments_of(json.dumps([odd])) == (Segment("sine\t", 0, 100, 10, 90, 20.0),)
    del odd["period"]
    assert validation.segments_of(json.dumps([odd]))[0].period == 0.0


@pytest.mark.parametrize(
    "text", ["3", "{}", "[3]", "[[]]", "[" * 100_000 + "]" * 100_000, json.dumps([GOOD, GOOD])]
)
def test_texts_without_segments(text):
    with pytest.raises(ValueError, match="segments: "):
        validation.segments_of(text)


def test_topics_of_one_axis_are_those_of_a_recording():
    validator = validation.MessageValidator()
    for number, name in ((1, "hilctl.SampleBlock"), (2, "robot.Pose")):
        assert validator.problem(Schema(number, b"", "protobuf", name)) == ""
    for number, (topic, schema_id) in enumerate([("/x/samples", 1), ("/robot/samples", 2)]):
        assert validator.problem(Channel(number, topic, "protobuf", {}, schema_id)) == ""
    assert [validator.topic(number) for number in range(2)] == ["/samples", ""]
    for topic in ("/y/samples", "/samples"):
        assert "one axis" in validator.problem(Channel(3, topic, "protobuf", {}, 1))
