"""Processor time that recording takes, beside the foxglove SDK writing the same messages.

    python -m tests.benchmark.writing [--seconds 20] [--goal 0.3]

A compensated run of the simulated rig, fifty blocks of 50 samples at a time, as the recorder takes
them out of the ring at 50 kHz. Both write zstd with checksums and index into a file, in turns, in
chunks as large as the default ``flush_s`` makes them. Exit code 1 where a million samples take
more than ``--goal`` s, or making and writing messages takes longer than the SDK needs to write
messages that are made already and hilctl to make them.
"""

import argparse
import statistics
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from unittest.mock import patch

import foxglove
from foxglove.mcap import MCAPWriteOptions

from hilctl.base.samples import Batch
from hilctl.experiment.parts import RecordingConfig
from hilctl.recording import schema
from hilctl.recording.messages import Encoded, MessageMaker, RecordingLayout
from hilctl.recording.writer import RecordingWriter, RunFacts
from hilctl.run.recorder import Recorder
from hilctl.run.start import checked_experiment
from hilctl.run.unpaced import run_unpaced

EXPERIMENT = Path(__file__).parents[2] / "configs" / "terfenol_sine_6a.yaml"
RATE_HZ = 50_000.0
LEVEL = 1  # of the SDK: of its levels the nearest to what hilctl does
BLOCKS = 50
BATCH_S = 0.05
FLUSH_BATCHES = round(RecordingConfig().flush_s / BATCH_S)
ROUNDS = 11
LAYOUT = RecordingLayout(RATE_HZ, "A", False, 1000.0, 1_800_000_000 * 10**9)
RUN = RunFacts({}, (), "name: writing\n", "", LAYOUT)


def batches(seconds: int, folder: Path) -> list[Batch]:
    """Return a run of the simulated rig as the recorder takes it out of the ring."""
    checked = checked_experiment(EXPERIMENT, [f"waveform.duration_s={seconds}"])
    found: list[Batch] = []

    def keep(_recorder: Recorder, batch: Batch) -> None:
        firsts = range(0, batch.flags.shape[0], BLOCKS)
        found.extend(batch.rows(slice(first, first + BLOCKS)) for first in firsts)

    with patch.object(Recorder, "batch", keep):
        run_unpaced(checked, folder / "run.mcap", overwrite=True)
    return found


def ours_s(run: list[Batch], path: Path) -> float:
    """Record a run; return what that took of the processor."""
    began_s = time.process_time()
    with path.open("wb") as stream:
        writer = RecordingWriter(stream, RUN)
        for number, batch in enumerate(run, start=1):
            writer.batch(batch)
            if number % FLUSH_BATCHES == 0:
                writer.flush()
        writer.finish({}, 0)
    return time.process_time() - began_s


def making_s(run: list[Batch]) -> float:
    """Make the messages of a run, and write none."""
    began_s = time.process_time()
    maker = MessageMaker(LAYOUT)
    for batch in run:
        for _ in maker.batch(batch):
            pass
    return time.process_time() - began_s


def each_message(run: list[Batch]) -> Iterator[tuple[str, int, bytes]]:
    """Yield topic, time and bytes of every message of a run."""
    maker = MessageMaker(LAYOUT)
    for batch in run:
        for message in maker.batch(batch):
            if isinstance(message, Encoded):
                yield message.topic, message.time_ns, message.data
            else:
                for time_ns, data in zip(
                    message.times_ns.tolist(), message.rows.split(), strict=True
                ):
                    yield message.topic, time_ns, data


def theirs_s(messages: list[tuple[str, int, bytes]], path: Path, chunk_bytes: int) -> float:
    """Let the SDK write messages; return what that took of the processor, all of its threads."""
    context = foxglove.Context()
    channels = {
        topic: foxglove.Channel(
            topic,
            schema=foxglove.Schema(
                name=f"hilctl.{name}", encoding="protobuf", data=schema.descriptor_set()
            ),
            message_encoding="protobuf",
            context=context,
        )
        for topic, name in schema.TOPICS.items()
    }
    options = MCAPWriteOptions(
        compression_level=LEVEL, compression_threads=0, chunk_size=chunk_bytes
    )
    began_s = time.process_time()
    with foxglove.open_mcap(path, context=context, allow_overwrite=True, writer_options=options):
        for topic, time_ns, data in messages:
            channels[topic].log(data, log_time=time_ns)
    return time.process_time() - began_s


def main() -> int:
    """Print the figures; return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n", maxsplit=1)[0])
    parser.add_argument("--seconds", type=int, default=20)
    parser.add_argument("--goal", type=float, default=0.3)
    asked = parser.parse_args()
    took: dict[str, list[float]] = {"ours": [], "making": [], "theirs": []}
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "run.mcap"
        run = batches(asked.seconds, path.parent)
        messages = list(each_message(run))
        millions = sum(batch.flags.size for batch in run) * 1e-6
        chunk_bytes = FLUSH_BATCHES * sum(len(data) for _, _, data in messages) // len(run)
        for _ in range(ROUNDS):
            took["ours"].append(ours_s(run, path))
            size = path.stat().st_size
            took["making"].append(making_s(run))
            took["theirs"].append(theirs_s(messages, path, chunk_bytes))
    per_million = {name: statistics.median(times) / millions for name, times in took.items()}
    # Of each round, so that a slow moment of the machine hits both.
    rounds = zip(took["ours"], took["making"], took["theirs"], strict=True)
    ratio = statistics.median(ours / (making + theirs) for ours, making, theirs in rounds)
    print(
        f"hilctl: {per_million['ours']:.3f} CPU-s a million samples, "
        f"{size / millions * 1e-6:.1f} bytes each"
    )
    print(f"  of it messages: {per_million['making']:.3f}")
    print(f"foxglove SDK, the same messages ready-made: {per_million['theirs']:.3f}")
    print(f"hilctl / (messages + SDK), median of {ROUNDS} rounds: {ratio:.3f}")
    return int(per_million["ours"] > asked.goal or ratio > 1.0)


if __name__ == "__main__":
    sys.exit(main())
