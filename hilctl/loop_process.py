"""The loop's own process: prepares everything, runs the loop, says how it went.

Started by the supervisor as ``python -m hilctl.loop_process`` with a JSON job on standard input.
It prints nothing and writes no file: all it has to say goes into the ring's control page.
"""

import gc
import json
import os
import signal
import sys
import time
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from hilctl.compensator import Compensator
from hilctl.config import Experiment
from hilctl.errors import DeviceError, HilctlError
from hilctl.experiment import LoadedExperiment, resolve
from hilctl.limiter import Limiter
from hilctl.loop import Loop, Outcome, Plan
from hilctl.pacer import LatePolicy, Pacer, SystemClock
from hilctl.ports import DeviceInfo
from hilctl.ring import Field, Phase, SampleRing
from hilctl.yamlio import Document

STOP_REASONS = {
    1: "stopped by Ctrl-C",
    2: "stopped by SIGTERM",
    3: "stopped by SIGHUP: the terminal went away",
    4: "stopped because the recording can't be written",
}


class Supervision:
    """What the loop and its supervisor tell each other once a tick."""

    def __init__(self, ring: SampleRing, pacer: Pacer, clock: SystemClock, supervisor: int) -> None:
        self._control = ring.control
        self._pacer = pacer
        self._clock = clock
        self._supervisor = supervisor

    def __call__(self) -> str:
        """Return why the run should end, or an empty text."""
        control = self._control
        control[Field.LOOP_BEAT_NS] = self._clock.now_ns()
        control[Field.LATE_TICKS] = self._pacer.counters.late_ticks
        if control[Field.STOP]:
            return STOP_REASONS.get(int(control[Field.STOP]), "stopped on request")
        return "" if self.supervised() else "stopped because the supervisor died"

    def supervised(self) -> bool:
        """Return whether the supervisor is still there."""
        return os.getppid() == self._supervisor


def main() -> int:
    """Run one job; the exit code is 0 where the loop ended by its way out."""
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)  # the supervisor decides, and the loop ramps down
    job = json.load(sys.stdin)
    ring = SampleRing.attach(Path(job["ring"]))
    try:
        loaded = resolve(Document("experiment", job["experiment"]), Path(job["folder"]))
        outcome = _run(job, ring, loaded)
    except HilctlError as error:
        return _failed(ring, str(error))
    except Exception as error:  # noqa: BLE001  the supervisor must hear of it and make the rig safe
        return _failed(ring, f"the loop broke: {type(error).__name__}: {error}")
    ring.write_text(json.dumps(asdict(outcome)))
    ring.put(Field.PHASE, Phase.ENDED)
    return 0


def _failed(ring: SampleRing, text: str) -> int:
    ring.write_text(text)
    ring.put(Field.PHASE, Phase.FAILED)
    return 1


def _run(job: dict[str, Any], ring: SampleRing, loaded: LoadedExperiment) -> Outcome:
    config, device = loaded.config, loaded.device
    compensator = Compensator(loaded.model, config.sample_rate_hz)
    compensator.warm_up()
    clock = SystemClock()
    period_ns = config.tick_s * 1e9
    policy = _late_policy(config, device.info)
    pacer = Pacer(clock, period_ns, policy, config.timing.late_after * period_ns)
    supervision = Supervision(ring, pacer, clock, job["supervisor"])
    plan = Plan(
        reference=np.load(job["reference"], mmap_mode="r"),
        in_um=config.waveform.unit == "um",
        block=config.block,
        stroke_um=config.limits.stroke_um,
        max_late_ns=config.timing.max_late_s * 1e9,
        latency_blocks=device.info.latency_blocks,
    )
    limiter = Limiter(config.command_limits(), 1.0 / config.sample_rate_hz)
    loop = Loop(plan, device, compensator, limiter, pacer, clock, ring, supervision)
    device.open(config.sample_rate_hz, config.block)
    try:
        gc.collect()
        gc.freeze()
        gc.disable()
        ring.put(Field.PHASE, Phase.READY)
        _await_go(ring, supervision)
        ring.put(Field.PHASE, Phase.RUNNING)
        outcome = loop.run(ring.get(Field.START_NS))
    except BaseException:
        device.make_safe(config.safe.value)
        raise
    finally:
        device.close()
    _leave_counters(ring, pacer)
    return outcome


def _late_policy(config: Experiment, info: DeviceInfo) -> LatePolicy:
    if info.latency_blocks:
        return "follow"
    return "catch_up" if info.buffered else config.timing.late_policy


def _await_go(ring: SampleRing, supervision: Supervision) -> None:
    while not ring.get(Field.GO):
        if not supervision.supervised():
            raise DeviceError("the supervisor died before the start")
        time.sleep(0.001)


def _leave_counters(ring: SampleRing, pacer: Pacer) -> None:
    counters = pacer.counters
    ring.put(Field.LATE_TICKS, counters.late_ticks)
    ring.put(Field.SKIPPED_TICKS, counters.skipped_ticks)
    ring.put(Field.WORST_LATE_NS, counters.worst_ns)
    ring.put(Field.WORST_LATE_TICK, counters.worst_tick)
    ring.put(Field.LONGEST_LATE_RUN, counters.longest_run)


if __name__ == "__main__":
    sys.exit(main())
