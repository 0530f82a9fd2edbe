"""Runs whose disk is full or slow, and whose wall clock is set: what is lost is counted."""

import json
import os
import resource
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import yaml

from hilctl.analysis.replay import replay
from hilctl.recording.reader import read

DEMO = Path(__file__).parents[2] / "configs" / "demo.yaml"
RATE_HZ = 5000
SECONDS = 4.0
RAMP_SAMPLES = round(0.2 * RATE_HZ)
EXPERIMENT = {
    "name": "disk_fault",
    "device": {"kind": "simulated_terfenol", "seed": 3},
    "sample_rate_hz": RATE_HZ,
    "block": 5,
    "waveform": {
        "kind": "sine",
        "unit": "A",
        "amplitude": 4.0,
        "frequency_hz": 5.0,
        "duration_s": SECONDS,
        "soft_start_s": 0.1,
    },
    "compensator": "none",
    "limits": {"peak_current_a": 5.0, "slew_a_per_s": 1000.0, "stroke_um": [-60.0, 60.0]},
    "safe": {"value": 0.0, "ramp_s": 0.2},
}
SLOW = """
import sys, time
from hilctl.run import recorder
from hilctl import cli

class SlowFile(recorder.OutputFile):
    '''A file on a disk that stands still once for as long as it is told, at its second MB or so.'''

    def begin(self):
        stream, self.stalled = super().begin(), False
        write = stream.write
        def slow(data):
            if not self.stalled and stream.tell() > {at_bytes}:
                self.stalled = True
                time.sleep({stall_s})
            return write(data)
        class Slow:
            def __getattr__(self, name):
                return slow if name == "write" else getattr(stream, name)
        return Slow()

recorder.OutputFile = SlowFile
sys.argv = ["hilctl", *sys.argv[1:]]
sys.exit(cli.main())
"""
OTHER_CLOCK = """
import datetime, os, time
from pathlib import Path

def stepped(now_ns=time.time_ns, path=Path(os.environ["CLOCK_STEP"])):
    return now_ns() + int(path.read_text() or 0)

class Stepped(datetime.datetime):
    @classmethod
    def now(cls, tz=None):
        return cls.fromtimestamp(stepped() * 1e-9, tz)

time.time_ns, time.time = stepped, lambda: stepped() * 1e-9
datetime.datetime = Stepped
"""


def start(folder: Path, *, code: str = "", preexec=None, environment=None, **recording):
    """Start a run in a process of its own; ``code`` stands for ``python -m hilctl``."""
    path = folder / "experiment.yaml"
    section = {"flush_s": 0.1, "ring_s": 1.0, **recording}
    path.write_text(yaml.safe_dump({**EXPERIMENT, "recording": section}), encoding="utf-8")
    program = ["-c", code] if code else ["-m", "hilctl"]
    words = ["run", str(path), "--output", str(folder / "run.mcap"), "--json"]
    return subprocess.Popen(
        [sys.executable, *program, *words],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        preexec_fn=preexec,  # noqa: PLW1509
        env={**os.environ, **(environment or {})},
    )


def end(process, code: int) -> dict:
    """Wait for the end; return the JSON it printed."""
    out, err = process.communicate(timeout=240)
    assert "Traceback" not in err
    assert process.returncode == code, f"{out}\n{err}"
    return json.loads(out)


def await_size(process, output: Path, size: int = 100_000) -> None:
    """Wait until the recording has grown to ``size`` bytes."""
    deadline = time.monotonic() + 240.0
    while not (output.exists() and output.stat().st_size > size):
        assert process.poll() is None, process.communicate()
        assert time.monotonic() < deadline
        time.sleep(0.02)


@pytest.mark.parametrize(
    ("on_failure", "whole"), [("stop", False), ("go_on", True)], ids=["stop", "go_on"]
)
def test_full_disk(tmp_path, on_failure, whole):
    """The run ramps down, or goes on to its end; every sample is in the file or counted as lost."""
    process = start(tmp_path, on_failure=on_failure, ring_s=4.0)
    await_size(process, tmp_path / "run.mcap")
    resource.prlimit(process.pid, resource.RLIMIT_FSIZE, (300_000, 300_000))
    printed = end(process, 3)
    assert printed["code"] == "fault"
    assert printed["output_safe"]
    assert "can't be written: File too large" in printed["reason"]
    assert printed["reason"].startswith("waveform completed") == whole
    recorded = read(tmp_path / "run.mcap").samples.index
    assert np.array_equal(recorded, np.arange(recorded.size))
    # Of the chunk that was cut by the full disk a reader may save some more.
    assert recorded.size >= printed["recorded_samples"] > 1000
    assert f"; {printed['dropped']} samples are lost: " in printed["reason"]
    total = printed["recorded_samples"] + printed["dropped"]
    waveform = round(SECONDS * RATE_HZ)
    assert (waveform <= total <= waveform + RAMP_SAMPLES) if whole else total < waveform


def test_disk_that_stands_still_longer_than_the_ring_ends_the_run(tmp_path):
    """The loop ramps down before there is no room left: nothing is lost."""
    process = start(tmp_path, code=SLOW.format(at_bytes=200_000, stall_s=2.0), on_failure="stop")
    printed = end(process, 3)
    assert printed["reason"] == "stopped because the disk keeps the recording waiting"
    assert printed["output_safe"]
    recording = read(tmp_path / "run.mcap")
    assert recording.dropped == 0
    assert np.array_equal(recording.samples.index, np.arange(recording.samples.index.size))
    assert recording.samples.command[-1] == 0.0
    assert replay(recording).identical


def test_run_that_goes_on_counts_what_a_slow_disk_lost(tmp_path):
    """The ring keeps a second, the rest is gone: the numbers say how much, and the file where."""
    process = start(tmp_path, code=SLOW.format(at_bytes=200_000, stall_s=2.5), on_failure="go_on")
    printed = end(process, 0)
    assert printed["reason"] == "waveform completed"
    recording = read(tmp_path / "run.mcap")
    index = recording.samples.index
    gaps = np.diff(index) - 1
    assert recording.dropped == printed["dropped"] == gaps.sum()
    assert printed["dropped"] > RATE_HZ
    assert index.size + printed["dropped"] == index[-1] + 1
    assert int(recording.end["dropped_in_ring"]) == printed["dropped"]
    # Ticks are late on a busy machine; a loop that waited for the disk would have stood still.
    assert int(recording.end["worst_late_ns"]) < 2.0e9
    assert replay(recording).identical


def test_short_stall_loses_nothing(tmp_path):
    """What the ring can take is no fault."""
    process = start(tmp_path, code=SLOW.format(at_bytes=200_000, stall_s=0.3), ring_s=4.0)
    printed = end(process, 0)
    assert (printed["dropped"], printed["reason"]) == (0, "waveform completed")
    assert replay(read(tmp_path / "run.mcap")).identical


def test_wall_clock_that_is_set_changes_nothing(tmp_path):
    """An hour back and three forward in the middle of a run: its times go on as they began."""
    clock, output = tmp_path / "clock", tmp_path / "run.mcap"
    clock.write_text("0", encoding="utf-8")
    (tmp_path / "sitecustomize.py").write_text(OTHER_CLOCK, encoding="utf-8")
    path = os.pathsep.join([str(tmp_path), *filter(None, [os.environ.get("PYTHONPATH")])])
    environment = {"PYTHONPATH": path, "CLOCK_STEP": str(clock)}
    before_ns = time.time_ns()
    process = start(tmp_path, environment=environment)
    await_size(process, output)
    for step_s in (-3600, 7200):
        clock.write_text(str(step_s * 10**9), encoding="utf-8")
        time.sleep(1.0)
    printed = end(process, 0)
    assert (printed["reason"], printed["dropped"]) == ("waveform completed", 0)
    recording = read(output)
    assert replay(recording).identical
    assert set(np.diff(recording.ticks.deadline_ns).tolist()) == {1_000_000}
    start_ns = int(recording.run["start_unix_ns"])
    assert 0 <= start_ns - before_ns < 60e9
    (ended,) = recording.events
    assert SECONDS <= (ended.time_ns - start_ns) * 1e-9 < SECONDS + 60.0


def test_memory_that_is_not_to_be_had_is_told(tmp_path):
    """Where the ring can't be made, nothing starts, no file is left, and one line says why."""

    def nothing() -> None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (50_000, 50_000))

    process = start(tmp_path, preexec=nothing)
    _, err = process.communicate(timeout=240)
    assert process.returncode == 3, err
    assert err.count("\n") == 1
    assert "ring: no memory: File too large; less recording.ring_s needs less of it" in err
    assert not (tmp_path / "run.mcap").exists()


def test_a_full_disk_below_standard_output_does_not_make_a_good_run_a_fault(tmp_path):
    """The run's result counts; that it could not be printed is said."""
    output = tmp_path / "run.mcap"
    command = [sys.executable, "-m", "hilctl", "run", str(DEMO)]
    command += ["--set", "waveform.duration_s=0.5", "--output", str(output), "--json"]
    with Path("/dev/full").open("w") as full:
        ended = subprocess.run(command, stdout=full, stderr=subprocess.PIPE, text=True, timeout=240)
    assert ended.returncode == 0, ended.stderr
    assert "No space left on device" in ended.stderr
    assert read(output).end["code"] == "completed"
