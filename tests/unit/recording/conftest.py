"""Recordings made of random batches."""

import functools
import json
from dataclasses import asdict
from types import SimpleNamespace

import numpy as np
import pytest
from mcap.data_stream import RecordBuilder
from mcap.records import Chunk, Message

from hilctl.base.device import AuxChannel
from hilctl.base.events import Event
from hilctl.base.samples import COLUMNS, BlockBatch, BlockHeader, Samples
from hilctl.base.segments import Segment
from hilctl.recording.encoder import RecordingLayout
from hilctl.recording.recording import TICK_COLUMNS
from hilctl.recording.writer import RecordingWriter, RunFacts

RATE_HZ = 50_000.0
START_NS = 1_800_000_000_000_000_000
BLOCK = 50
AUX = (AuxChannel("coil_c", "°C", "temperature"), AuxChannel("preload_n"))
SEGMENT = Segment("sine", 0, 5000, 100, 4900, 200.0)
ENDED = Event(17, "info", "run_ended", "waveform completed", time_ns=START_NS + 5)


def batch(first, blocks, *, dropped=0, seed=0):
    """Random blocks that follow one another, the first after a gap."""
    rng = np.random.default_rng(seed)
    heads = np.zeros((blocks, len(BlockHeader)), dtype=np.int64)
    heads[:, BlockHeader.FIRST_SAMPLE] = first + BLOCK * np.arange(blocks)
    heads[:, BlockHeader.SAMPLES] = BLOCK
    heads[0, BlockHeader.DROPPED_BEFORE] = dropped
    heads[:, BlockHeader.DEADLINE_NS] = heads[:, BlockHeader.FIRST_SAMPLE] * 20_000
    heads[:, BlockHeader.LATE_NS] = rng.integers(0, 90_000, blocks)
    heads[:, BlockHeader.EXCHANGE_NS] = rng.integers(0, 50_000, blocks)
    return BlockBatch(
        heads,
        rng.normal(size=(blocks, 4)),
        rng.normal(size=(blocks, len(COLUMNS), BLOCK)),
        rng.integers(0, 31, (blocks, BLOCK)).astype(np.uint32),
        rng.normal(size=(blocks, len(AUX))),
    )


def write(
    stream, batches, *, unit="A", measures=True, own_input=True, waveform_unit="um", events=(),
    finish=True, ended_at=0,
):  # fmt: skip
    facts = RunFacts(
        facts={"compensator": "rdpi", "aux": json.dumps([asdict(each) for each in AUX])},
        segments=(SEGMENT,),
        experiment_yaml="name: x\n",
        model_yaml="model: y\n",
        device_files={"profile.yaml": "vendor: z\n"},
        layout=RecordingLayout(
            sample_rate_hz=RATE_HZ,
            command_unit=unit,
            measures_command=measures,
            scope_rate_hz=1000.0,
            start_unix_ns=START_NS,
            records_input=own_input,
            waveform_unit=waveform_unit,
            ages_readings=measures,
            corrects_readings=measures,
        ),
    )
    writer = RecordingWriter(stream, facts)
    for each in batches:
        writer.batch(each)
        writer.flush()
    for each in events:
        writer.event(each)
    writer.event(ENDED)
    if finish:
        writer.finish({"code": "completed", "late_ticks": "3"}, ended_at)
    return writer


def samples(batches):
    return functools.reduce(Samples.followed_by, [each.samples() for each in batches])


@pytest.fixture(scope="session")
def make():
    """What recordings are made with: batches, the writer, and the constants they go by."""
    return SimpleNamespace(
        batch=batch, samples=samples, write=write, rate_hz=RATE_HZ, start_ns=START_NS, block=BLOCK,
        segment=SEGMENT, ended=ENDED,
    )  # fmt: skip


@pytest.fixture
def recorded(tmp_path, make):
    """A finished recording of three batches with a gap before the last."""
    batches = [
        make.batch(0, 4),
        make.batch(200, 30, seed=1),
        make.batch(1900, 3, dropped=200, seed=2),
    ]
    return written(tmp_path / "run.mcap", batches), batches


def same_samples(found, expected):
    """Compare bytes, so that NaN equals NaN and -0.0 does not equal 0.0."""
    for name in ("index", *COLUMNS, "flags"):
        one, other = getattr(found, name), getattr(expected, name)
        assert (one.dtype, one.tobytes()) == (other.dtype, other.tobytes()), name


def same_ticks(found, expected):
    for name in TICK_COLUMNS:
        assert getattr(found, name).tolist() == getattr(expected, name).tolist(), name


def written(path, batches, **options):
    """Write a recording of batches; return its path."""
    with path.open("wb") as stream:
        write(stream, batches, **options)
    return path


def raw(record):
    builder = RecordBuilder()
    record.write(builder)
    return builder.end()


def message(number, data=b""):
    return Message(channel_id=4, log_time=number, data=data, publish_time=0, sequence=number)


def chunk(data, *, size=None, crc=0):
    return Chunk("", data, 0, 0, crc, len(data) if size is None else size)
