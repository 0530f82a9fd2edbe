"""The loop's own process: prepares everything, runs the loop, says how it went.

Started by the supervisor as ``python -m hilctl.run.loop_process`` with a JSON job on its standard
input. It prints nothing and writes no file: all it has to say goes into the ring's control page.
"""

import json
import math
import os
import signal
import sys
import time
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from hilctl.base.arrays import F64
from hilctl.base.device import DeviceInfo
from hilctl.base.errors import DeviceError, HilctlError, InputError
from hilctl.base.events import LoopEvent
from hilctl.base.files import TextFiles
from hilctl.base.yaml.document import Document
from hilctl.experiment.feedback import make_feedback
from hilctl.experiment.file import Experiment
from hilctl.experiment.interlocks import interlock_limits
from hilctl.experiment.load import LoadedExperiment, resolve
from hilctl.loop.compensator import Compensator
from hilctl.loop.in_flight import DelayLine
from hilctl.loop.interlocks import Interlocks
from hilctl.loop.limiter import Limiter
from hilctl.loop.loop import Loop
from hilctl.loop.pacer import LatePolicy, Pacer, SystemClock
from hilctl.loop.plan import Outcome, Plan, Tuning
from hilctl.machine.realtime import prepare, require, step_facts
from hilctl.run.ring import SampleRing
from hilctl.run.shared_page import Field, Phase

# Plain numbers: looking up an enumeration's member takes longer than writing it.
_LOOP_BEAT_NS, _NEXT_SAMPLE = int(Field.LOOP_BEAT_NS), int(Field.NEXT_SAMPLE)
_LATE_TICKS, _STOP = int(Field.LATE_TICKS), int(Field.STOP)
_SUPERVISOR_BEAT_NS = int(Field.SUPERVISOR_BEAT_NS)
_TUNE_WANTED, _TUNE_TAKEN = int(Field.TUNE_WANTED), int(Field.TUNE_TAKEN)

_ALWAYS_LATE_S = 2.0
STOP_REASONS = {
    1: "stopped by Ctrl-C",
    2: "stopped by SIGTERM",
    3: "stopped by SIGHUP: the terminal went away",
    4: "stopped because the recording can't be written",
    5: "stopped by hilctl stop",
}


class Supervision:
    """The loop's view of its supervisor, by the control page.

    Args:
        ring: Shared with the supervisor.
        pacer: Whose counters it passes on.
        clock: Time.
        supervisor: Its process number.
        silence_s: Longest that it may be silent.
    """

    def __init__(
        self,
        ring: SampleRing,
        pacer: Pacer,
        clock: SystemClock,
        supervisor: int,
        silence_s: float,
    ) -> None:
        self._ring = ring
        self._control = ring.numbers
        self._counters = pacer.counters
        self._clock = clock
        self._supervisor = supervisor
        self._silence_ns = silence_s * 1e9

    def beat(self, next_sample: int) -> str:
        """Show that the loop lives; return why the run should end, or an empty text."""
        control = self._control
        now_ns = self._clock.now_ns()
        control[_LOOP_BEAT_NS] = now_ns
        control[_NEXT_SAMPLE] = next_sample
        control[_LATE_TICKS] = self._counters.late_ticks
        if control[_STOP]:
            return STOP_REASONS.get(control[Field.STOP], "stopped on request")
        if not self.supervised():
            return "stopped because the supervisor died"
        if now_ns - control[_SUPERVISOR_BEAT_NS] > self._silence_ns:
            return f"stopped because the supervisor was silent for {self._silence_ns * 1e-9:g} s"
        return ""

    def closing(self) -> None:
        """Say that the loop is over, and that the device may take its time."""
        self._control[Field.LOOP_BEAT_NS] = self._clock.now_ns()
        self._control[Field.PHASE] = Phase.CLOSING

    def tuning(self) -> Tuning | None:
        """Return a change of the reference that is wanted and new."""
        control, ring = self._control, self._ring
        wanted = control[_TUNE_WANTED]
        if wanted == control[_TUNE_TAKEN]:
            return None
        gain, offset = ring.get_float(Field.TUNE_GAIN), ring.get_float(Field.TUNE_OFFSET)
        control[Field.TUNE_TAKEN] = wanted
        return Tuning(gain, offset, ring.get(Field.TUNE_SAMPLES))

    def tell(self, event: LoopEvent) -> None:
        """Leave an event for the recording."""
        self._ring.push_event(event)

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
        document = Document("experiment", job["experiment"])
        loaded = resolve(document, Path(job["folder"]), files=TextFiles(job["files"]))
        outcome = _run(job, ring, loaded)
    except InputError as error:  # before the device was opened
        return _failed(ring, str(error), Phase.REFUSED)
    except HilctlError as error:
        return _failed(ring, str(error))
    except Exception as error:  # noqa: BLE001  the supervisor must hear of it and make the rig safe
        return _failed(ring, f"the loop broke: {type(error).__name__}: {error}")
    ring.write_text(json.dumps(asdict(outcome)))
    ring.put(Field.PHASE, Phase.ENDED)
    return 0


def _failed(ring: SampleRing, text: str, phase: Phase = Phase.FAILED) -> int:
    ring.write_text(text)
    ring.put(Field.PHASE, phase)
    return 1


def _run(job: dict[str, Any], ring: SampleRing, loaded: LoadedExperiment) -> Outcome:
    config, device = loaded.config, loaded.device
    clock = SystemClock()
    period_ns = config.tick_s * 1e9
    policy = _late_policy(config, device.info)
    pacer = Pacer(clock, period_ns, policy, config.timing.late_after * period_ns)
    supervision = Supervision(ring, pacer, clock, job["supervisor"], job["silence_s"])
    compensator = Compensator(loaded.model, config.sample_rate_hz)
    compensator.warm_up()
    if "state" in job:
        compensator.restore(np.array(job["state"]))
    limits = interlock_limits(config, device.info)
    loop = Loop(
        _plan(job, config),
        device,
        compensator,
        Limiter(config.command_limits(), 1.0 / config.sample_rate_hz),
        Interlocks(limits, config.sample_rate_hz),
        pacer,
        clock,
        DelayLine(ring.sent),
        ring,
        supervision,
        make_feedback(config, compensator),
    )
    steps = prepare(config.realtime)
    if config.realtime.require:
        require(steps)
    device.open(config.sample_rate_hz, config.block)
    try:
        ring.write_text(json.dumps(step_facts(steps)))
        ring.put(Field.PHASE, Phase.READY)
        _await_go(ring, supervision)
        ring.put(Field.PHASE, Phase.RUNNING)
        outcome = loop.run(ring.get(Field.START_NS))
        supervision.closing()
    except BaseException:
        device.make_safe(config.safe.value)
        raise
    finally:
        device.close()
        _leave_counters(ring, pacer)
    return outcome


def _plan(job: dict[str, Any], config: Experiment) -> Plan:
    timing = config.timing
    late = timing.max_consecutive_late
    return Plan(
        reference=_mapped(job["reference"]),
        ahead=_mapped(job["ahead"]) if "ahead" in job else None,
        in_um=config.waveform.unit == "um",
        block=config.block,
        max_late_ns=timing.max_late_s * 1e9,
        max_consecutive_late=math.ceil(_ALWAYS_LATE_S / config.tick_s) if late is None else late,
        grace_ticks=int(timing.grace_s / config.tick_s),
        keep_all=config.recording.on_failure == "stop",
    )


def _mapped(path: str) -> F64:
    values: F64 = np.load(path, mmap_mode="r").view(np.ndarray)  # quicker to slice
    return values


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
