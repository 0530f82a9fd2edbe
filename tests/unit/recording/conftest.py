"""Recordings made of random batches."""

from types import SimpleNamespace

import numpy as np
import pytest

from hilctl.base.samples import Batch
from hilctl.base.segments import Segment
from hilctl.recording.data import Event
from hilctl.recording.writer import RecordingWriter, RunFacts

RATE_HZ = 50_000.0
START_NS = 1_800_000_000_000_000_000
BLOCK = 50
SEGMENT = Segment("sine", 0, 5000, 100, 4900, 200.0)


def batch(first, blocks, *, dropped=0, seed=0):
    """Random blocks that follow one another, the first after a gap."""
    rng = np.random.default_rng(seed)
    heads = np.zeros((blocks, 7), dtype=np.int64)
    heads[:, 1] = first + BLOCK * np.arange(blocks)
    heads[:, 2] = BLOCK
    heads[0, 3] = dropped
    heads[:, 4] = heads[:, 1] * 20_000
    heads[:, 5] = rng.integers(0, 90_000, blocks)
    heads[:, 6] = rng.integers(0, 50_000, blocks)
    return Batch(
        heads,
        rng.normal(size=(blocks, 4)),
        rng.normal(size=(blocks, 6, BLOCK)),
        rng.integers(0, 31, (blocks, BLOCK)).astype(np.uint32),
    )


def write(stream, batches, *, unit="A", measures=True, own_input=True, finish=True, ended_at=0):
    """Write a recording, a chunk a batch."""
    facts = RunFacts(
        facts={"command_unit": unit, "sample_rate_hz": repr(RATE_HZ), "compensator": "rdpi"},
        segments=(SEGMENT,),
        experiment_yaml="name: x\n",
        model_yaml="model: y\n",
        sample_rate_hz=RATE_HZ,
        command_unit=unit,
        measures_command=measures,
        scope_rate_hz=1000.0,
        records_input=own_input,
    )
    writer = RecordingWriter(stream, facts, START_NS)
    for each in batches:
        writer.batch(each)
        writer.flush()
    writer.event(Event(START_NS + 5, 17, "info", "run_ended", "waveform completed"))
    if finish:
        writer.finish({"code": "completed", "late_ticks": "3"}, ended_at)
    return writer


@pytest.fixture(scope="session")
def make():
    """What recordings are made with: batches, the writer, and the constants they go by."""
    return SimpleNamespace(
        batch=batch, write=write, rate_hz=RATE_HZ, start_ns=START_NS, block=BLOCK, segment=SEGMENT
    )
