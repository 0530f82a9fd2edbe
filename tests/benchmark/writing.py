"""Processor time that recording takes: messages, chunks, compression and index.

Run it with ``python -m tests.benchmark.writing``; see README.md beside it. The data is a run of the
simulated rig, in fifty blocks of 50 samples, as the recorder takes them out of the ring at 50 kHz.
"""

import argparse
import statistics
import sys
import tempfile
import time
from pathlib import Path
from unittest.mock import patch

from hilctl.base.samples import BlockBatch
from hilctl.experiment.sections.recording_settings import RecordingConfig
from hilctl.recording.encoder import RecordingLayout
from hilctl.recording.writer import RecordingWriter, RunFacts
from hilctl.run.recorder import Recorder
from hilctl.run.start import checked_run
from hilctl.run.unpaced import run_unpaced

EXPERIMENT = Path(__file__).parents[2] / "configs" / "terfenol_sine_6a.yaml"
RATE_HZ = 50_000.0
BLOCKS = 50
BATCH_S = 0.05
FLUSH_BATCHES = round(RecordingConfig().flush_s / BATCH_S)
ROUNDS = 5
LAYOUT = RecordingLayout(RATE_HZ, "A", False, 1000.0, 1_800_000_000 * 10**9)
RUN = RunFacts({}, (), "name: writing\n", "", LAYOUT)


def batches(seconds: int, folder: Path) -> list[BlockBatch]:
    """Return a run of the simulated rig as the recorder takes it out of the ring."""
    checked = checked_run(EXPERIMENT, [f"waveform.duration_s={seconds}"])
    found: list[BlockBatch] = []

    def keep(_recorder: Recorder, batch: BlockBatch) -> None:
        firsts = range(0, batch.flags.shape[0], BLOCKS)
        found.extend(batch.rows(slice(first, first + BLOCKS)) for first in firsts)

    with patch.object(Recorder, "batch", keep):
        run_unpaced(checked, folder / "run.mcap", overwrite=True)
    return found


def written_s(run: list[BlockBatch], path: Path) -> float:
    """Record a run; return the processor time in s."""
    began_s = time.process_time()
    with path.open("wb") as stream:
        writer = RecordingWriter(stream, RUN)
        for number, batch in enumerate(run, start=1):
            writer.batch(batch)
            if number % FLUSH_BATCHES == 0:
                writer.flush()
        writer.finish({}, 0)
    return time.process_time() - began_s


def main() -> int:
    """Run the benchmark; the exit code is 1 if recording takes more than ``--max-cores``."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n", maxsplit=1)[0])
    parser.add_argument("--seconds", type=int, default=20)
    parser.add_argument("--max-cores", type=float, default=0.05, help="at 50 kHz")
    asked = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "run.mcap"
        run = batches(asked.seconds, path.parent)
        took_s = [written_s(run, path) for _ in range(ROUNDS)]
        size = path.stat().st_size
    samples = sum(batch.flags.size for batch in run)
    cores = statistics.median(took_s) * RATE_HZ / samples
    print(f"{cores:.4f} core at 50 kHz, {size / samples:.1f} bytes per sample")
    return int(cores > asked.max_cores)


if __name__ == "__main__":
    sys.exit(main())
