"""The loop's own process: prepares everything, runs the loop, says how it went.

Started by the supervisor in :mod:`hilctl.run.waiting_loop`, before that has its experiment;
the job comes as JSON over the socket that is its standard input, and the locks with it. It prints
nothing and writes no file: all it has to say goes into the ring's page.
"""

import json
import os
import signal
import sys
import time
from collections.abc import Callable
from contextlib import ExitStack

from hilctl.base.errors import DeviceError, HilctlError, InputError, RunError
from hilctl.experiment.condition import conditioning_of
from hilctl.experiment.load import LoadedExperiment
from hilctl.kernels import tick
from hilctl.kernels.elsewhere import compiled_elsewhere
from hilctl.kernels.interlock import interlock_block
from hilctl.kernels.jit import load
from hilctl.kernels.limit import limit_block
from hilctl.loop.loop import Loop
from hilctl.loop.pacer import SpinningClock, SystemClock, spin_ns
from hilctl.loop.plan import Outcome
from hilctl.machine.memory import ProcessMemory
from hilctl.machine.realtime import (
    be_ordinary,
    prepare,
    refusals,
    require,
    require_another_cpu,
    step_facts,
)
from hilctl.machine.usage import ProcessUsage
from hilctl.run.assemble import assemble
from hilctl.run.host import RingHost, SharedWindow
from hilctl.run.job import Job
from hilctl.run.ring import SampleRing
from hilctl.run.shared_page import Field, PageText, Phase, SharedPage
from hilctl.run.starting import starting_output
from hilctl.run.waiting_loop import received_job

_EVERY_RUN = (
    limit_block,
    interlock_block,
    tick.follow_block,
    tick.plan_block,
    tick.answer_block,
    tick.begin_tick,
    tick.end_tick,
)


def main() -> int:
    """Run one job; the exit code is 0 where the loop ended by its safe ramp."""
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)  # the supervisor decides, and the loop ramps down
    be_ordinary()  # as its maker is by the time that it has a job
    with ExitStack() as compiling:
        compiling.enter_context(compiled_elsewhere())
        load(*_EVERY_RUN)  # while the supervisor checks
        text = received_job(sys.stdin.fileno())
        # Without text there is no run for this one.
        return _carried_out(text, compiling.close) if text else 0


def _carried_out(text: str, all_compiled: Callable[[], None]) -> int:
    """Carry out a job, and leave what came of it in the ring's page; return the exit code."""
    job = Job.from_json(text)
    ring = SampleRing(job.ring_path)
    page = ring.page
    try:
        outcome = run_job(job, ring, job.load(), all_compiled)
    except InputError as error:  # before anything has moved
        return _failed(page, str(error), Phase.REFUSED)
    except HilctlError as error:
        return _failed(page, str(error))
    except Exception as error:  # noqa: BLE001  the supervisor must know it and make the rig safe
        return _failed(page, f"the loop broke: {type(error).__name__}: {error}")
    page.leave_outcome(outcome)
    return 0


def _failed(page: SharedPage, text: str, phase: Phase = Phase.FAILED) -> int:
    # The text first: the phase says that it is there.
    page.write_text(PageText.ERROR, text)
    page.put(Field.PHASE, phase)
    return 1


def run_job(
    job: Job,
    ring: SampleRing,
    loaded: LoadedExperiment,
    all_compiled: Callable[[], None] = lambda: None,
) -> Outcome:
    """Run a job whose experiment is loaded, from set-up to the closed device.

    Args:
        job: What to run, and for whom.
        ring: Where samples go.
        loaded: The experiment.
        all_compiled: Called before the first tick, when no more kernel is needed.

    Raises:
        HilctlError: It could not start, or broke; the output was put at its safe value.
    """
    config, device, page = loaded.config, loaded.device, ring.page
    awake_ns = spin_ns(config.tick_s * 1e9) if config.realtime.wait == "spin" else 0
    clock = SpinningClock(awake_ns) if awake_ns else SystemClock()
    host = RingHost(ring, clock, job.supervisor, job.silence_s)
    conditioning = conditioning_of(loaded, job.stands_um)
    reference, input_um = job.arrays()
    plan = assemble(
        loaded,
        reference,
        input_um,
        job.memory,
        conditioning,
        operator=job.adapted,
        window=SharedWindow(page, job.samples) if job.samples > reference.size else None,
        heat_a2=job.heat_a2,
    )
    loop = Loop(plan, device, host)
    require_another_cpu(config.realtime, len(os.sched_getaffinity(0)))
    # After the warm-up, so that all it has mapped gets locked; before the device is opened, so that
    # a refusal moves nothing.
    steps = prepare(config.realtime, never_sleeps=awake_ns >= config.tick_s * 1e9)
    if config.realtime.require:
        require(steps)
    device.open(config.sample_rate_hz, config.block)
    try:
        waveform_at = loop.begin_at(starting_output(device, config.safe.at_start))
    except BaseException:
        device.close()  # and no safe value: what starts elsewhere is not to step there
        raise
    try:
        # A device may load kernels of its own when it is opened.
        all_compiled()
        ProcessMemory().release()
        page.put(Field.WAVEFORM_AT, waveform_at)
        page.write_text(PageText.SET_UP, json.dumps([step_facts(steps), refusals(steps)]))
        # After the text, which the supervisor reads then.
        page.put(Field.PHASE, Phase.READY)
        start_ns = _await_go(page, host)
        page.put(Field.PHASE, Phase.RUNNING)
        before = ProcessUsage.now()
        outcome = loop.run(start_ns)
        page.leave_usage(ProcessUsage.now().since(before))
        # Before the device is closed: that may take its time-outs, and is no hang.
        host.closing()
    except BaseException as error:
        try:
            device.make_safe(config.safe.value)
        except DeviceError as second:
            # The cause first: a device that can't be reached is often only what follows from it.
            cause = str(error) if isinstance(error, HilctlError) else f"the loop broke: {error!r}"
            text = f"{cause}; the safe value could not be confirmed: {second}"
            raise RunError(text) from error
        raise
    finally:
        device.close()
        page.leave_lateness(loop.lateness)
    return outcome


def _await_go(page: SharedPage, host: RingHost) -> int:
    """Return when the first tick is due."""
    while not page.get(Field.GO):
        if not host.supervised():
            # The loop ends in its first tick then: by its ramp, where the output is not at rest.
            return host.clock.now_ns()
        time.sleep(0.001)
    return page.get(Field.START_NS)
