"""How long ``hilctl list`` takes over thousands of recordings, before and after it knows them.

Run it with ``python -m tests.benchmark.catalogue``; see README.md beside it.
"""

import argparse
import io
import json
import os
import resource
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from datetime import UTC, datetime, timedelta
from pathlib import Path

from mcap.records import Attachment, Channel, McapRecord, Message, Metadata, Schema
from mcap.writer import CompressionType, Writer

from hilctl.recording.salvage import Salvage
from hilctl.run.start import checked_experiment
from hilctl.run.unpaced import run_unpaced

EXPERIMENT = Path(__file__).parents[2] / "configs" / "terfenol_sine_6a_uncompensated.yaml"
SETTINGS = [
    *(f"waveform.{key}" for key in ("frequency_hz=200", "duration_s=0.03", "soft_start_s=0.005")),
    "waveform.soft_end_s=0.005",
    "safe.ramp_s=0.01",
]
A_FOLDER = 500
FIRST = datetime(2026, 1, 1, tzinfo=UTC)
WHERE = 'frequency_hz > 100 and label.sample == "A7"'


def made(path: Path) -> list[McapRecord]:
    """Run once, and return the records of the recording."""
    run_unpaced(checked_experiment(EXPERIMENT, SETTINGS), path)
    return list(Salvage(io.BytesIO(path.read_bytes())).records())


def facts_of(number: int) -> dict[str, str]:
    """Return what differs from one recording to the next."""
    labels = {"sample": f"A{number % 50}", "operator": "Ann" if number % 3 else "Bo", "t": 20.5}
    return {
        "run_id": f"{number:032x}",
        "started": (FIRST + timedelta(minutes=number)).isoformat(timespec="milliseconds"),
        "labels": json.dumps(labels),
    }


def write(path: Path, records: Sequence[McapRecord], number: int) -> None:
    """Write a recording anew under another identity."""
    with path.open("wb") as stream:
        writer = Writer(stream, compression=CompressionType.NONE)
        writer.start("", "hilctl")
        for record in records:
            match record:
                case Schema():
                    writer.register_schema(record.name, record.encoding, record.data)
                case Channel():
                    writer.register_channel(record.topic, "protobuf", record.schema_id)
                case Message():
                    times = record.log_time, record.publish_time
                    writer.add_message(record.channel_id, times[0], record.data, times[1])
                case Attachment():
                    times = record.create_time, record.log_time
                    writer.add_attachment(*times, record.name, record.media_type, record.data)
                case Metadata():
                    other = facts_of(number) if record.name == "hilctl.run" else {}
                    writer.add_metadata(record.name, {**record.metadata, **other})
        writer.finish()


def timed(words: Sequence[str], cache: Path) -> tuple[float, float, str]:
    """Return wall time and processor time of a command in s, and what it printed last."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    began = time.perf_counter()
    command = [sys.executable, "-P", "-m", "hilctl", "list", *words]
    env = {**os.environ, "XDG_CACHE_HOME": str(cache)}
    done = subprocess.run(command, env=env, check=True, capture_output=True, text=True)
    wall_s = time.perf_counter() - began
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    cpu_s = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return wall_s, cpu_s, done.stdout.splitlines()[-1]


def main() -> int:
    """Make the recordings, list them, and judge the times."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--recordings", type=int, default=10_000)
    parser.add_argument("--max-cold-s", type=float, default=10.0)
    parser.add_argument("--max-warm-s", type=float, default=0.5)
    parser.add_argument("--repeat", type=int, default=9, help="Looks at what is known.")
    given = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="hilctl-catalogue-") as place:
        folder = Path(place) / "recordings"
        records = made(Path(place) / "made.mcap")
        for number in range(given.recordings):
            path = folder / f"{number // A_FOLDER:03d}" / f"run-{number:05d}.mcap"
            path.parent.mkdir(parents=True, exist_ok=True)
            write(path, records, number)
        return judged(folder, Path(place) / "cache", given)


def judged(folder: Path, cache: Path, given: argparse.Namespace) -> int:
    """Print the times, and return 1 where one is missed."""
    bytes_each = (folder / "000" / "run-00000.mcap").stat().st_size
    print(f"{given.recordings} recordings of {bytes_each} bytes")
    wall_s, cpu_s, last = timed([str(folder)], cache)
    print(f"cold: {wall_s:.2f} s, {cpu_s:.2f} s of processor time ({last})")
    missed = wall_s > given.max_cold_s
    for name, words in {"warm": [], "--where": ["--where", WHERE], "--json": ["--json"]}.items():
        looks = [timed([str(folder), *words], cache) for _ in range(given.repeat)]
        median_s = statistics.median(look[0] for look in looks)
        cpu_s = statistics.median(look[1] for look in looks)
        best_s = min(look[0] for look in looks)
        times = f"median {median_s:.2f} s, best {best_s:.2f} s, {cpu_s:.2f} s of processor time"
        print(f"{name}: {times} ({looks[-1][2]})")
        missed = missed or (name == "warm" and median_s > given.max_warm_s)
    return int(missed)


if __name__ == "__main__":
    sys.exit(main())
