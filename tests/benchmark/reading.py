"""Speed and peak memory of the commands that read recordings, on generated recordings.

Run it with ``python -m tests.benchmark.reading``; see README.md beside it. The recordings have the
chunks of a run, the commands of its compensator for a periodic sine, and a displacement. Each
command runs in its own process, measured from start to end.
"""

import argparse
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from hilctl.base.samples import COLUMNS, BlockBatch, BlockHeader
from hilctl.base.segments import Segment
from hilctl.base.types import F64, U32
from hilctl.experiment.preflight import CheckedExperiment
from hilctl.loop.compensator import Compensator
from hilctl.loop.limiter import Limiter
from hilctl.models.model_file import dump_model
from hilctl.recording.encoder import RecordingLayout
from hilctl.recording.writer import RecordingWriter, RunFacts
from hilctl.run.metadata import run_facts
from hilctl.run.start import checked_experiment

EXPERIMENT = Path(__file__).parents[2] / "configs" / "terfenol_sine_6a.yaml"
RATE_HZ = 50_000
BLOCK = 50
PERIOD = 5_000
SOFT = 10_000
SPAN = RATE_HZ
BATCH = 5_000  # a run closes a chunk every 100 ms
NOISE_UM = 0.02
SENSOR_STEP_UM = 2.0**-9
COMMANDS = "replay,report,report --html,export,identify --model ppi"
MOST_BYTES = 2**30
FLAT = 1.25


class Content:
    """Samples of a run: a soft start, then one second over and over."""

    def __init__(self, checked: CheckedExperiment) -> None:
        config, model = checked.loaded.config, checked.loaded.model
        compensator = Compensator(model, RATE_HZ)
        self.state = compensator.state()
        limiter = Limiter(config.command_limits(), 1.0 / RATE_HZ)
        self.previous = limiter.last
        cycle = np.sin(2.0 * np.pi * np.arange(PERIOD) / PERIOD)
        swelling = 0.5 - 0.5 * np.cos(np.pi * np.arange(SOFT) / SOFT)
        start = swelling * (40.8 * np.resize(cycle, SOFT) - 6.9)
        span = np.resize(40.8 * cycle - 6.9, SPAN)
        parts = [self._made(part, compensator, limiter) for part in (start, span, span, span)]
        if parts[2][0].tobytes() != parts[3][0].tobytes():
            raise AssertionError("the compensator does not repeat itself")
        self.begin = np.concatenate((parts[0][0], parts[1][0]), axis=1)
        self.begin_flags = np.concatenate((parts[0][1], parts[1][1]))
        self.span, self.span_flags = parts[2]

    @staticmethod
    def _made(reference: F64, compensator: Compensator, limiter: Limiter) -> tuple[F64, U32]:
        wanted, command = np.empty_like(reference), np.empty_like(reference)
        flags = np.zeros(reference.size, dtype=np.uint32)
        compensator.process(reference, wanted)
        limiter.limit(wanted, command, flags)
        noise = np.random.default_rng(3).normal(0.0, NOISE_UM, reference.size)
        measured = reference + 0.4 * np.gradient(reference) + noise
        known = {
            "reference_um": reference,
            "wanted": wanted,
            "command": command,
            "displacement_um": np.round(measured / SENSOR_STEP_UM) * SENSOR_STEP_UM,
            "input_um": reference,
        }
        absent = np.full_like(reference, np.nan)
        return np.array([known.get(name, absent) for name in COLUMNS]), flags

    def batches(self, seconds: int) -> Iterator[BlockBatch]:
        """Yield a run of that many seconds after its soft start."""
        for at in range(0, SOFT + seconds * SPAN, BATCH):
            values, flags, start = self.begin, self.begin_flags, at
            if at >= self.begin_flags.size:
                values, flags = self.span, self.span_flags
                start = (at - self.begin_flags.size) % SPAN
            blocks = BATCH // BLOCK
            batch = BlockBatch.empty(blocks, BLOCK, self.state.size + 1)
            shaped = values[:, start : start + BATCH].reshape(len(COLUMNS), blocks, BLOCK)
            batch.columns[:] = shaped.transpose(1, 0, 2)
            batch.flags[:] = flags[start : start + BATCH].reshape(blocks, BLOCK)
            batch.states[:, :-1], batch.states[:, -1] = self.state, self.previous
            first = at + BLOCK * np.arange(blocks)
            batch.heads[:, BlockHeader.FIRST_SAMPLE] = first
            batch.heads[:, BlockHeader.SAMPLES] = BLOCK
            batch.heads[:, BlockHeader.DEADLINE_NS] = first * (10**9 // RATE_HZ)
            batch.heads[:, BlockHeader.LATE_NS] = 40_000 + first % 7919 * 11
            batch.heads[:, BlockHeader.EXCHANGE_NS] = 30_000 + first % 6547 * 3
            yield batch


def make(path: Path, seconds: int) -> int:
    """Write a recording; return its samples."""
    checked = checked_experiment(EXPERIMENT, [])
    content = Content(checked)
    samples = SOFT + seconds * SPAN
    segment = Segment("sine 10 Hz", 0, samples, SOFT, samples, float(PERIOD))
    model = checked.loaded.model
    assert model is not None
    layout = RecordingLayout(RATE_HZ, "A", False, 1000.0, 1_800_000_000 * 10**9)
    facts = run_facts(checked, "2027-01-15T08:00:00.000+00:00", dump_model(model))
    run = RunFacts(facts, (segment,), checked.loaded.yaml_text, dump_model(model), layout)
    with path.open("xb") as stream:
        writer = RecordingWriter(stream, run)
        for batch in content.batches(seconds):
            writer.batch(batch)
            writer.flush()
        end = {"code": "completed", "reason": "waveform completed", "late_ticks": "0"}
        writer.finish({**end, "skipped_ticks": "0", "output_safe": "true"}, samples)
    return samples


def measured(*command: str) -> tuple[float, float, int]:
    """Run a command of hilctl; return its wall and processor time in s, and its peak in bytes."""
    # Bytecode is kept, whatever the surroundings say.
    surroundings = {**os.environ, "PYTHONDONTWRITEBYTECODE": ""}
    line = [sys.executable, "-m", "hilctl", *command]
    began = time.monotonic()
    child = subprocess.Popen(line, stdout=subprocess.DEVNULL, env=surroundings)
    _, status, usage = os.wait4(child.pid, 0)
    child.returncode = os.waitstatus_to_exitcode(status)
    if child.returncode:
        sys.exit(f"hilctl {' '.join(command)} ended with {child.returncode}")
    took_s = time.monotonic() - began
    return took_s, usage.ru_utime + usage.ru_stime, usage.ru_maxrss * 1024


def main() -> int:
    """Print one line per recording and command; return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n", maxsplit=1)[0])
    parser.add_argument("--seconds", type=int, nargs="+", default=[60, 900])
    parser.add_argument("--folder", type=Path, help="keep the recordings here")
    parser.add_argument("--goal", type=float, default=3.0, help="million samples per second")
    parser.add_argument("--commands", default=COMMANDS)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        folder = options.folder or Path(temporary)
        folder.mkdir(parents=True, exist_ok=True)
        return judge(folder, options)


def judge(folder: Path, options: argparse.Namespace) -> int:
    """Measure all commands on all recordings; return the exit code."""
    missed = False
    peaks: dict[str, list[int]] = {}
    extra = {
        "report --html": [str(folder / "page.html"), "--overwrite"],
        "export": [str(folder / "out.parquet"), "--overwrite"],
        "identify --model ppi": ["--output", str(folder / "model.yaml"), "--overwrite"],
    }
    print(f"{'command':>20} {'samples':>14} {'M/s':>6} {'M/cpu-s':>8} {'MiB':>6}")
    for seconds in sorted(options.seconds):
        path = folder / f"made_{seconds}_s.mcap"
        samples = SOFT + seconds * SPAN
        if not path.exists():
            make(path, seconds)
        for name in options.commands.split(","):
            verb, *flags = name.split()
            wall_s, cpu_s, peak = measured(verb, str(path), *flags, *extra.get(name, []))
            rate = samples / wall_s / 1e6
            peaks.setdefault(name, []).append(peak)
            line = f"{name:>20} {samples:14,} {rate:6.2f} {samples / cpu_s / 1e6:8.2f}"
            print(f"{line} {peak / 2**20:6.0f}", flush=True)
            slow = rate < options.goal and seconds == max(options.seconds)
            missed |= slow or peak > MOST_BYTES
    grown = any(each[-1] > FLAT * each[0] for each in peaks.values())
    return int(missed or grown)


if __name__ == "__main__":
    sys.exit(main())
