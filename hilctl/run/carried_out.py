"""A job carried out by the loop's process: prepares everything, runs the loop, says how it went.

It prints nothing and writes no file: all it has to say goes into the ring's page.
"""

import json
import os
import time

from hilctl.base.errors import HilctlError, InputError, RunError
from hilctl.experiment.condition import conditioning_of
from hilctl.experiment.run_parts import RunParts
from hilctl.loop.loop import Loop
from hilctl.loop.pacer import SystemClock
from hilctl.loop.plan import Outcome
from hilctl.loop.safe_output import SafeGoal, describe, drive_to_safe
from hilctl.machine.memory import ProcessMemory
from hilctl.machine.realtime import (
    prepare,
    refusals,
    require,
    step_facts,
)
from hilctl.machine.usage import ProcessUsage
from hilctl.run.assemble import assemble
from hilctl.run.host import RingHost
from hilctl.run.job import Job
from hilctl.run.ring import SampleRing
from hilctl.run.shared_page import Field, PageText, Phase, SharedPage
from hilctl.run.starting import starting_output


def carry_out(data: bytes) -> int:
    """Carry out a job, and leave what came of it in the ring's page; return the exit code.

    Args:
        data: See :meth:`hilctl.run.job.Job.to_bytes`.
    """
    job = Job.from_bytes(data)
    ring = SampleRing(job.ring, at_once=True)
    try:
        return _carry_out(job, ring)
    finally:
        if os.getppid() != job.supervisor:
            from hilctl.run.run_folder import keep_removed  # of no use to any other run

            keep_removed()


def _carry_out(job: Job, ring: SampleRing) -> int:
    page = ring.page
    try:
        outcome = run_job(job, ring, job.parts())
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
    page.publish(Field.PHASE, phase)
    return 1


def run_job(job: Job, ring: SampleRing, parts: RunParts) -> Outcome:
    """Run a job, from set-up to the closed device.

    Args:
        job: What to run, and for whom.
        ring: Where samples go.
        parts: Of the experiment.

    Raises:
        HilctlError: It could not start, or broke; the output was put at its safe value.
    """
    config, device, page = parts.config, parts.device, ring.page
    host = RingHost(ring, SystemClock(), job.supervisor, job.silence_s)
    conditioning = conditioning_of(parts, job.stands_um)
    reference, input_um = job.arrays()
    plan = assemble(
        parts,
        reference,
        input_um,
        job.state,
        conditioning,
        operator=job.adapted,
        heat_a2=job.heat_a2,
    )
    loop = Loop(plan, device, host)
    # After the warm-up, so that all it has mapped gets locked; before the device is opened, so that
    # a refusal moves nothing.
    steps = prepare(config.realtime)
    if config.realtime.require:
        require(steps)
    device.open(config.sample_rate_hz, config.block)
    try:
        output = starting_output(device, config.safe.at_start)
        waveform_at = loop.begin_at(output)
        ProcessMemory().release()  # once open: a device may compile kernels of its own
        page.put_float(Field.OUTPUT_AT_START, output)
        page.put(Field.REAL_TIME, int(any(s.name == "fifo" and s.outcome == "done" for s in steps)))
        page.put(Field.WAVEFORM_AT, waveform_at)
        page.write_text(PageText.SET_UP, json.dumps([step_facts(steps), refusals(steps)]))
        # After the text, which the supervisor reads then.
        page.publish(Field.PHASE, Phase.READY)
        start_ns = _await_go(page, host)
    except BaseException:
        device.close()  # and no safe value: nothing has moved, and the output is not to step there
        raise
    try:
        page.publish(Field.PHASE, Phase.RUNNING)
        before = ProcessUsage.now()
        outcome = loop.run(start_ns)
        page.leave_usage(ProcessUsage.now().since(before))
        # Before the device is closed: that may take its time-outs, and is no hang.
        host.closing()
    except BaseException as error:
        limits = config.command_limits()
        pending = bool(page.get(Field.EXCHANGING)) and not device.info.simulated
        goal = SafeGoal(limits.safe, limits.ramp_per_s, ring.last_command(), pending)
        found = drive_to_safe(device, goal, on_write=page.note_safe_write)
        if found.state != "confirmed":
            # The cause first: a device that can't be reached is often only what follows from it.
            cause = str(error) if isinstance(error, HilctlError) else f"the loop broke: {error!r}"
            raise RunError(f"{cause}; {describe(found.state, found.error)}") from error
        raise
    finally:
        device.close()
        page.leave_lateness(loop.lateness)
    return outcome


def _await_go(page: SharedPage, host: RingHost) -> int:
    """Return when the first tick is due.

    Raises:
        RunError: The supervisor has died; nothing has moved.
    """
    while not page.observe(Field.GO):
        if not host.supervised():
            raise RunError("the supervisor died before the start; nothing has moved")
        time.sleep(0.001)
    return page.get(Field.START_NS)
