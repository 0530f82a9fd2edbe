"""Read damaged recordings: each command accepts a file or rejects it with a message.

A file comes from a golden recording: bits flipped, bytes cut or moved, or records removed,
duplicated, or filled with wrong numbers, with valid checksums. A traceback, a warning, or more than
ten seconds of processor time is a defect, and no kernel may access memory outside its arrays.
"""

import io
import json
import os
import random
import struct
import subprocess
import sys
import time
import traceback
import warnings
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import zstandard
from google.protobuf.message import DecodeError
from mcap.records import Attachment, Channel, Message, Metadata, Schema
from mcap.writer import CompressionType, Writer

from hilctl.analysis.catalogue import entry_of
from hilctl.analysis.export import export
from hilctl.analysis.replay import replay
from hilctl.analysis.report import summarize
from hilctl.base.errors import ConfigError, HilctlError
from hilctl.base.segments import Segment
from hilctl.cli.reports import render_report
from hilctl.experiment.device_state import initial_state_after
from hilctl.kernels.hysteresis import play_sum
from hilctl.lab.identify.data.cycles import loops_from_pieces
from hilctl.lab.identify.data.data_files import history_from_pieces
from hilctl.lab.run_report.decimation import overview
from hilctl.lab.run_report.run_page import page
from hilctl.models.base import HysteresisModel
from hilctl.models.linear_stages import FirstMode, FurtherMode
from hilctl.models.literature.bouc_wen import BoucWenModel
from hilctl.models.literature.generalised_plays import GeneralisedModel, PlayEnvelope
from hilctl.models.literature.krasnoselskii import KrasnoselskiiPokrovskiiModel
from hilctl.models.literature.preisach import PreisachModel
from hilctl.models.model_file import dump_model
from hilctl.models.plays import PpiModel
from hilctl.models.staged import FieldLag, StagedModel
from hilctl.recording import reader, schema
from hilctl.recording.reader import read
from hilctl.recording.recording import Recording
from hilctl.recording.recover import recover_recording
from hilctl.recording.recovery_scan import RecoveryScan
from hilctl.recording.time_range import TimeRange
from tests.published import terfenol_rdpi

ROOT = Path(__file__).parents[2]
FILES = 40
CHECKED_FILES = 60
GOLDEN = sorted((ROOT / "recordings" / "golden").glob("*.mcap"))
NUMBERS = (0, 1, 2, 49, 51, 2**16, 2**31, 2**32 - 1, 2**40, 2**53, 2**63 - 1, 2**63, 2**64 - 1)
VALUES = (0.0, -1.0, float("nan"), float("inf"), float("-inf"), 1e308, -1e308, 5e-324, 1e30)
TEXTS = (
    "", "0", "-1", "1e999", "nan", "inf", "1e-300", "1e300", "9" * 5000, "none", "true", "V", "A",
    "ppi", "\x1b[31mred", "<script>", "[/x]", "$\\frac{$", "\u202e", "x" * 100_000, "\0", "\r\n",
    "[" * 20_000, "{}", "[1]", "null", '[{"label":1}]',
)  # fmt: skip
SLOWEST_S = 10.0
SPAN = (-7.0, 7.0)
PREISACH = PreisachModel(
    thresholds=(0.0, 0.5), lowest=-5.0, cell=2.5, slopes=((2.0, 3.0, 2.0), (0.5, 0.1, 0.0)),
    command_span=SPAN,
)  # fmt: skip
MODE = FurtherMode(
    natural_hz=600.0, damping_ratio=0.03, antiresonance_hz=630.0, antiresonance_damping_ratio=0.03
)
MODELS: tuple[HysteresisModel, ...] = (
    terfenol_rdpi(),
    PREISACH,
    KrasnoselskiiPokrovskiiModel(
        lowest=-6.0, spacing=4.0, weights=((1.0,), (0.1, 1.0), (0.0, 0.2, 1.0)), command_span=SPAN
    ),
    BoucWenModel(direct=5.0, hysteretic=1.0, beta=0.6, gamma=0.1, command_span=SPAN),
    GeneralisedModel(
        direct=20.0, weights=(3.0,), thresholds=(0.1,), rising=PlayEnvelope(slope=0.2),
        falling=PlayEnvelope(slope=0.2, shift=0.1), command_span=SPAN,
    ),
    StagedModel.around(
        PREISACH, lag=FieldLag(tau_s=1e-4, growth_per_unit=0.3),
        structure=FirstMode(natural_hz=2200.0, damping_ratio=0.12), modes=(MODE,), delay_s=3e-5,
    ),
)  # fmt: skip


def records_of(path: Path) -> list[object]:
    with path.open("rb") as stream:
        return list(RecoveryScan(stream).records())


def rewritten(records: list[object], chance: random.Random) -> bytes:
    """Return records as a file with right lengths, checksums and index."""
    stream = io.BytesIO()
    compression = chance.choice((CompressionType.ZSTD, CompressionType.LZ4, CompressionType.NONE))
    writer = Writer(stream, chunk_size=chance.choice((1000, 100_000)), compression=compression)
    writer.start(profile="", library="")
    schemas, channels = {0: 0}, {}
    for record in records:
        match record:
            case Schema():
                number = writer.register_schema(record.name, record.encoding, record.data)
                schemas[record.id] = number
            case Channel():
                channels[record.id] = writer.register_channel(
                    record.topic, record.message_encoding, schemas.get(record.schema_id, 0)
                )
            case Message() if record.channel_id in channels:
                number = channels[record.channel_id]
                times = record.log_time, record.data, record.publish_time
                writer.add_message(number, *times, record.sequence)
            case Metadata():
                writer.add_metadata(record.name, record.metadata)
            case Attachment():
                times = record.create_time, record.log_time
                writer.add_attachment(*times, record.name, record.media_type, record.data)
    writer.finish()
    return stream.getvalue()


def changed_message(record: Message, topic: str, chance: random.Random) -> Message:
    """Return a message of a topic with one field that is wrong."""
    decoded = schema.message_class(schema.TOPICS[topic])()
    with suppress(DecodeError):  # its channel was given another topic before
        decoded.ParseFromString(record.data)
    field = chance.choice(decoded.DESCRIPTOR.fields)
    is_text = field.type == field.TYPE_STRING
    is_whole = field.type in {field.TYPE_UINT32, field.TYPE_UINT64, field.TYPE_SINT64}

    def wrong() -> object:
        if is_text:
            return chance.choice(TEXTS)
        if not is_whole:
            return chance.choice(VALUES)
        bits = 32 if field.type == field.TYPE_UINT32 else 63 if "_ns" in field.name else 64
        return chance.choice(NUMBERS) % 2**bits

    if not field.is_repeated:
        setattr(decoded, field.name, wrong())
    else:
        values = getattr(decoded, field.name)
        how = chance.randrange(4)
        if how == 0 or not values:
            values.extend([wrong()] * chance.choice((1, 50, 1000)))
        elif how == 1:
            del values[chance.randrange(len(values)) :]
        elif how == 2:
            values[chance.randrange(len(values))] = wrong()
        else:
            values[:] = [wrong()] * len(values)
    log_time = chance.choice((record.log_time, *NUMBERS)) if topic == "/events" else record.log_time
    data = decoded.SerializeToString()
    return Message(record.channel_id, log_time, data, record.publish_time, record.sequence)


def changed_facts(record: Metadata, chance: random.Random) -> Metadata:
    """Return facts of which one is wrong."""
    facts = dict(record.metadata)
    name = chance.choice(("sample_rate_hz", "segments", "command_unit", "compensator", *facts))
    if name == "segments" and chance.random() < 0.8:
        segments = [Segment("sine", 0, 2000, 1000, 2000, 100.0).to_mapping()]
        key = chance.choice(("label", "start", "stop", "steady_start", "steady_stop", "period"))
        segments[0][key] = chance.choice((*NUMBERS, *VALUES, *TEXTS[:20], None, [], -1))
        facts[name] = json.dumps(segments * chance.choice((1, 1, 2, 1000)))
    elif chance.random() < 0.2:
        facts.pop(name, None)
    else:
        facts[name] = chance.choice(TEXTS)
    return Metadata(record.name, facts)


def changed_text(record: Attachment, chance: random.Random) -> Attachment:
    """Return an attachment with another number, another model, or a few bytes less."""
    text = record.data.decode(errors="replace")
    how = chance.randrange(4)
    if how == 0 and record.name == "model.yaml":
        text = dump_model(chance.choice(MODELS))
    elif how == 1:
        text = chance.choice(TEXTS)
    else:
        words = text.split(" ")
        place = chance.randrange(len(words))
        words[place] = chance.choice((*map(str, VALUES), *map(str, NUMBERS), *TEXTS[:10]))
        text = " ".join(words)
    data = text.encode()
    return Attachment(record.create_time, record.log_time, record.name, record.media_type, data)


def changed_records(path: Path, chance: random.Random) -> bytes:
    """Return a recording of which one to three records are wrong, under right checksums."""
    records = records_of(path)
    for _ in range(chance.randint(1, 3)):
        topics = {each.id: each.topic for each in records if isinstance(each, Channel)}
        kinds = [Message, Message, Metadata, Attachment, Schema, Channel]
        kind = chance.choice(kinds)
        places = [
            place
            for place, each in enumerate(records)
            if isinstance(each, kind)
            and not (isinstance(each, Message) and topics.get(each.channel_id) == "/scope")
        ]
        if not places:
            continue
        place = chance.choice(places if chance.random() < 0.7 else [places[0], places[-1]])
        how = chance.randrange(10)
        if how == 0:
            del records[place]
        elif how == 1:
            records.insert(place, records[place])
        elif how == 2:
            other = chance.choice(places)
            records[place], records[other] = records[other], records[place]
        else:
            records[place] = _changed(records[place], topics, chance)
    return rewritten(records, chance)


def _changed(record: object, topics: dict[int, str], chance: random.Random) -> object:
    match record:
        case Message() if topics.get(record.channel_id) in schema.TOPICS:
            return changed_message(record, topics[record.channel_id], chance)
        case Metadata():
            return changed_facts(record, chance)
        case Attachment():
            return changed_text(record, chance)
        case Schema():
            name = chance.choice(("hilctl.Event", "", *TEXTS[:20]))
            return Schema(record.id, record.data, record.encoding, name)
        case Channel():
            topic = chance.choice((*schema.TOPICS, *TEXTS[:20]))
            encoding = chance.choice(("protobuf", "json", ""))
            number = chance.choice((0, 1, 2, record.schema_id))
            return Channel(record.id, topic, encoding, {}, number)
    return record


def other_model(path: Path, chance: random.Random) -> bytes:
    """Return a recording with another model, and a memory of its size that no model has left."""
    model = chance.choice(MODELS)
    size = model.inverse(50_000.0).state().size + chance.choice((0, 0, 0, 1, -1))
    text = dump_model(model)
    for _ in range(chance.randrange(3)):
        words = text.split(" ")
        words[chance.randrange(len(words))] = str(chance.choice((*VALUES, *NUMBERS)))
        text = " ".join(words)
    records = records_of(path)
    topics = {each.id: each.topic for each in records if isinstance(each, Channel)}
    for place, each in enumerate(records):
        if isinstance(each, Attachment) and each.name == "model.yaml":
            times = each.create_time, each.log_time
            records[place] = Attachment(*times, each.name, each.media_type, text.encode())
        if isinstance(each, Message) and topics[each.channel_id] == "/samples":
            block = schema.message_class("SampleBlock")()
            block.ParseFromString(each.data)
            if block.previous_command:
                values = [chance.choice((*VALUES, chance.uniform(-9, 9))) for _ in range(size)]
                block.state[:] = values
                if chance.random() < 0.5:
                    block.input_um[:] = [chance.choice(VALUES)] * len(block.input_um)
            times = each.log_time, block.SerializeToString(), each.publish_time
            records[place] = Message(each.channel_id, *times, each.sequence)
    return rewritten(records, chance)


def changed_bytes(path: Path, chance: random.Random) -> bytes:
    """Return a recording with some bytes flipped, cut, moved or zeroed."""
    data = bytearray(path.read_bytes())
    for _ in range(chance.choice((1, 1, 2, 8))):
        how = chance.randrange(6)
        at = chance.randrange(len(data)) if chance.random() < 0.5 else chance.randrange(6000)
        at = min(at, len(data) - 9)
        if how <= 1:
            data[at] ^= 1 << chance.randrange(8)
        elif how == 2:
            data[at : at + 8] = struct.pack("<Q", chance.choice(NUMBERS))
        elif how == 3:
            del data[max(at, 100) :]
            data += bytes(100)
        elif how == 4:
            size = chance.randrange(5000)
            data[at : at + size] = bytes(min(size, len(data) - at))
        else:
            other = chance.randrange(len(data))
            data[at:at] = data[other : other + chance.randrange(5000)]
    return bytes(data)


def bomb(path: Path, chance: random.Random) -> bytes:
    """Return a recording with chunks that expand to gigabytes, or say so."""
    data = path.read_bytes()
    say = chance.choice((2**20, 2**25, 2**30, 2**40))
    real = chance.choice((2**20, 2**25, 2**28))
    body = zstandard.ZstdCompressor(level=1).compress(bytes(real))
    head = struct.pack("<QQQII", 0, 0, say, 0, 4) + b"zstd" + struct.pack("<Q", len(body))
    chunk = b"\x06" + struct.pack("<Q", len(head) + len(body)) + head + body
    at = data.index(b"\x04\0\0\0zstd") - 37
    return data[:at] + chunk * chance.choice((1, 20)) + data[at:]


def damaged(number: int, seed: int) -> bytes:
    """Return a damaged recording, the same for the same number and seed."""
    chance = random.Random(f"{seed} {number}")
    path = chance.choice(GOLDEN)
    makers = (changed_records, changed_bytes, other_model, bomb)
    make = chance.choices(makers, (63, 25, 10, 2))[0]
    return make(path, chance)


def _report(recording: Recording, _path: Path) -> None:
    summary = summarize(recording)
    json.dumps(summary.to_mapping())
    render_report(summary)


def _html(recording: Recording, _path: Path) -> None:
    assert "<script>" not in page(recording, summarize(recording))


def _replay(recording: Recording, _path: Path) -> None:
    json.dumps(replay(recording).to_mapping())


def _export(recording: Recording, path: Path) -> None:
    for suffix in (".csv", ".npz", ".parquet", ".mat"):
        export(recording, path.with_suffix(suffix), overwrite=True)


def _pieces(_recording: Recording, path: Path) -> None:
    """Read it in pieces, as the commands do: refused where the whole is not, never otherwise."""
    usual, reader.PIECE_SAMPLES = reader.PIECE_SAMPLES, 300
    try:
        for stretch in (None, TimeRange(0.01, 0.05)):
            pieces = reader.RecordingStream(path, stretch)
            summary, _ = overview(pieces)
            json.dumps(summary.to_mapping())
            with suppress(HilctlError):
                json.dumps(replay(pieces).to_mapping())
            export(pieces, path.with_suffix(".npz"), overwrite=True)
    finally:
        reader.PIECE_SAMPLES = usual


def _identify(recording: Recording, _path: Path) -> None:
    with suppress(HilctlError):
        history_from_pieces([recording])
    loops_from_pieces([recording])


def _initial_state(recording: Recording, path: Path) -> None:
    model = PpiModel(
        direct=2.0, weights=(0.5,), thresholds=(0.1,), input_unit=recording.command_unit
    )
    initial_state_after(path, model, recording.sample_rate_hz, 2e9, 0.0)


COMMANDS: dict[str, Callable[[Recording, Path], None]] = {
    "report": _report,
    "replay": _replay,
    "pieces": _pieces,
    "export": _export,
    "identify": _identify,
    "initial_state": _initial_state,
    "html": _html,
}


def recover(path: Path) -> None:
    """Recover a file; what comes of it must be sound, and readable where the facts are."""
    target = path.with_name("recovered.mcap")
    target.unlink(missing_ok=True)
    recovered = recover_recording(path, output=target)
    if not recovered.sound:
        again = recover_recording(target, output=path.with_name("again.mcap"))
        assert again.sound, again.reason


def attempt(run: Callable[[], None]) -> tuple[str, str]:
    """Run something; return how it ended, and why where that is a defect."""
    began = time.process_time()
    try:
        with warnings.catch_warnings(action="error"):
            run()
        outcome, text = "done", ""
    except HilctlError as error:
        outcome, text = "refused", ""
        if not str(error) or ("\n" in str(error).strip() and not isinstance(error, ConfigError)):
            outcome, text = "defect", repr(error)
    except Exception:  # noqa: BLE001  whatever it is, it is what this looks for
        outcome, text = "defect", traceback.format_exc()
    took_s = time.process_time() - began
    return ("slow", f"{took_s:.1f} s") if took_s > SLOWEST_S else (outcome, text)


def outcomes(path: Path, commands: Iterable[str] = COMMANDS) -> Iterator[tuple[str, str, str]]:
    """Give a file to commands, and recover it; yield name, outcome, and the cause of a defect."""
    found: list[Recording] = []
    outcome, text = attempt(lambda: found.append(read(path)))
    yield "read", outcome, text
    yield "list", *attempt(lambda: json.dumps(entry_of(path, "", 0, 0), allow_nan=False))
    for name in commands if found else ():
        yield name, *attempt(partial(COMMANDS[name], found[0], path))
    yield "recover", *attempt(partial(recover, path))


@pytest.mark.slow
@pytest.mark.parametrize("part", range(4))
def test_damaged_recordings_are_read_or_rejected(tmp_path, part):
    path = tmp_path / "damaged.mcap"
    found = []
    for number in range(part, FILES, 4):
        path.write_bytes(damaged(number, seed=3))
        commands = ["report", "replay", "pieces", "identify", "initial_state"]
        commands += ["export"] if number % 8 == 0 else []
        commands += ["html"] if number % 20 == 0 else []
        results = list(outcomes(path, commands))
        defects = [(name, text) for name, how, text in results if how not in {"done", "refused"}]
        assert not defects, f"file {number}: {defects[0][0]}\n{defects[0][1]}"
        found += [how for _, how, _ in results]
    assert {"done", "refused"} <= set(found)


def check_bounds(folder: Path) -> None:
    """Run the kernels of damaged recordings; they must be compiled with bounds checks."""
    with pytest.raises(IndexError):
        play_sum(np.zeros(4), (0.0, 1.0, np.ones(3), np.ones(3)), np.zeros(1), np.zeros(4))
    path = folder / "damaged.mcap"
    found = []
    for number in range(CHECKED_FILES):
        path.write_bytes(damaged(number, seed=7))
        results = list(outcomes(path, ("replay", "initial_state", "pieces")))
        assert all(how in {"done", "refused"} for _, how, _ in results), (number, results)
        found += results
    assert ("replay", "done", "") in found


@pytest.mark.slow
def test_kernels_stay_within_their_arrays(tmp_path, request):
    """A process and a kernel cache of their own, compiled with bounds checks."""
    cache = request.config.cache.mkdir("kernels-with-bounds-checks")
    checked = {"NUMBA_BOUNDSCHECK": "1", "NUMBA_CACHE_DIR": str(cache)}
    code = "import pathlib, sys; import tests.property.test_mutated_recordings as test; "
    code += "test.check_bounds(pathlib.Path(sys.argv[1]))"
    command = [sys.executable, "-c", code, str(tmp_path)]
    done = subprocess.run(
        command, cwd=ROOT, env={**os.environ, **checked}, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stdout + done.stderr
