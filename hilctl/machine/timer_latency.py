"""Timer latency, measured in a separate process with the pacer and set-up of the loop.

``python -m hilctl.machine.timer_latency`` reads a JSON job from standard input, measures, and
writes the steps of the set-up as JSON to standard output.
"""

import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from hilctl import OWN_ENVIRONMENT
from hilctl.base.device import Clock
from hilctl.base.errors import InputError, RunError
from hilctl.base.subprocesses import python_command
from hilctl.base.types import I64
from hilctl.loop.pacer import LatePolicy, LateRules, Pacer, SystemClock
from hilctl.machine.rt_setup import Realtime, SetUpStep, prepare

MAX_RATE_HZ = 20e3
"""Highest measurable rate, in ticks per second."""

_POLL_S = 0.1
_PATIENCE_S = 30.0
_START_DELAY_NS = 50_000_000
_HOPELESS_NS = 500_000_000
_QUANTILES = (50.0, 90.0, 99.0, 99.9)


@dataclass(frozen=True, slots=True)
class Latency:
    """Measured timer latency.

    Attributes:
        late_ns: int64[m], time from each tick's deadline to its wake-up.
    """

    rate_hz: float
    late_ns: I64
    steps: tuple[SetUpStep, ...]

    @property
    def longest_period_ns(self) -> float:
        """Longest time between two wake-ups."""
        return 1e9 / self.rate_hz + float(np.diff(self.late_ns).max(initial=0))

    @property
    def kept_rate_hz(self) -> float:
        """Highest rate at which no period would have doubled."""
        return 1e9 / max(1.0, float(np.diff(self.late_ns).max(initial=0)))

    @property
    def kept(self) -> bool:
        """Whether no period was over twice the nominal one (RTXI's criterion)."""
        return self.longest_period_ns <= 2e9 / self.rate_hz

    def percentiles_us(self) -> dict[str, float]:
        """Return p50, p90, p99, p99.9 and max of the lateness."""
        values = np.percentile(self.late_ns, _QUANTILES) * 1e-3
        named = {f"p{q:g}": float(v) for q, v in zip(_QUANTILES, values, strict=True)}
        return {**named, "max": float(self.late_ns.max()) * 1e-3}


def measure(
    rate_hz: float,
    seconds: float,
    settings: Realtime,
    on_progress: Callable[[float], None] = lambda _: None,
    policy: LatePolicy = "catch_up",
) -> Latency:
    """Measure wake-up lateness in a new process; with policy ``skip`` a stall counts once.

    Raises:
        InputError: The rate is out of range.
        RunError: The process failed, or took too long.
    """
    if not 0.0 < rate_hz <= MAX_RATE_HZ:
        raise InputError(f"rate must be in (0, {MAX_RATE_HZ:g}] Hz to be measured: {rate_hz:g}")
    with tempfile.TemporaryDirectory(prefix="hilctl-") as folder:
        output = Path(folder) / "late_ns.npy"
        job = {
            "output": str(output),
            "rate_hz": rate_hz,
            "ticks": max(2, round(rate_hz * seconds)),
            "settings": settings.model_dump(),
            "parent": os.getpid(),
            "policy": policy,
        }
        answer = _ask(json.dumps(job), seconds, on_progress)
        steps = tuple(SetUpStep(**step) for step in json.loads(answer))
        return Latency(rate_hz, np.load(output), steps)


def _ask(job: str, seconds: float, on_progress: Callable[[float], None]) -> str:
    started = time.monotonic()
    with subprocess.Popen(
        python_command("-m", "hilctl.machine.timer_latency"),
        stdin=subprocess.PIPE,
        env=OWN_ENVIRONMENT | os.environ,
        stdout=subprocess.PIPE,
        text=True,
        start_new_session=True,  # the parent handles Ctrl-C
    ) as process:
        assert process.stdin is not None
        assert process.stdout is not None
        try:
            with suppress(BrokenPipeError):  # it has ended, see its exit code
                process.stdin.write(job)
                process.stdin.close()
            while process.poll() is None:
                elapsed_s = time.monotonic() - started
                if elapsed_s > seconds + _PATIENCE_S:
                    raise RunError(f"the measurement did not end in {elapsed_s:.0f} s")
                on_progress(elapsed_s)
                time.sleep(_POLL_S)
            answer = process.stdout.read()
        finally:
            process.kill()
    if process.returncode:
        raise RunError(f"the measurement ended with exit code {process.returncode}")
    return answer


def watch(pacer: Pacer, late_ns: I64, clock: Clock, supervised: Callable[[], bool]) -> int:
    """Fill ``late_ns`` (int64[m]) tick by tick; return the number of ticks measured.

    It stops early if the parent has ended, or if ticks are so late that the process never sleeps.
    """
    pacer.begin(clock.now_ns() + _START_DELAY_NS)
    for k in range(late_ns.size):
        pacer.wait()
        late_ns[k] = pacer.late_ns
        if pacer.late_ns > _HOPELESS_NS or not supervised():
            return k + 1
    return late_ns.size


def _run(job: dict[str, Any]) -> tuple[SetUpStep, ...]:
    clock = SystemClock()
    period_ns = 1e9 / job["rate_hz"]
    pacer = Pacer(clock, period_ns, job["policy"], LateRules(period_ns))
    late_ns = np.zeros(job["ticks"], dtype=np.int64)
    # After the array: later allocations would cause page faults during the measurement.
    steps = prepare(Realtime(**job["settings"]))
    ticks = watch(pacer, late_ns, clock, lambda: os.getppid() == job["parent"])
    np.save(job["output"], late_ns[:ticks])
    return steps


if __name__ == "__main__":
    json.dump([asdict(step) for step in _run(json.load(sys.stdin))], sys.stdout)
