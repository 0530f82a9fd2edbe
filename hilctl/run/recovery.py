"""Recovery of dead runs: samples left in memory are added to their recordings."""

import signal
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path

from hilctl.base.errors import HilctlError
from hilctl.base.events import Event
from hilctl.base.samples import BlockBatch, BlockHeader
from hilctl.experiment.device_state import finish_state
from hilctl.experiment.state_files import MachineTime
from hilctl.loop.safe_output import LoopOutcome, describe
from hilctl.recording.recording_files import is_being_recorded
from hilctl.recording.recover import recover_recording
from hilctl.run.metadata import end_facts
from hilctl.run.run_folder import RunFolder, runs, taken_over
from hilctl.run.shared.ring import SampleRing, safe_result_of
from hilctl.run.shared.shared_page import PageField, PageSlot, Phase, SharedPage

_DIED = LoopOutcome("fault", "supervisor and loop died", 0, "unknown")
_RESULT_S = 1.0
_POLL_S = 0.02


@dataclass(frozen=True, slots=True)
class RecoveredRun:
    """A dead run that another command has finished: one axis of it."""

    name: str
    recording: Path
    safe: bool  # whether loop or guardian confirmed the safe value
    text: str
    kept: Path | None = None  # folder of samples that were not recovered; None if all were
    started: bool = True  # whether the loop had started; otherwise nothing has moved


def recover_dead_runs() -> list[RecoveredRun]:
    """Finish the recordings of all runs of this user whose supervisor and loop are dead.

    Each recording has its own result.
    A guardian may still be active. The folder of a run stays for it, or until another command has
    made an unsafe output safe.
    """
    found: list[RecoveredRun] = []
    for run in runs():
        if run.recorded and not run.alive and _is_settled(run):
            run.remove()
        if run.recorded or run.supervised or (run.alive and run.loops):
            continue
        _await_guardian(run)
        with taken_over(run) as ours, _undisturbed():
            if ours:
                found += (recovered := _recover(run))
                if all(each.kept is None for each in recovered):
                    for each in recovered:
                        finish_state(each.recording, MachineTime.now())
                    _finish(run, recovered[0])
    return found


def _await_guardian(run: RunFolder) -> None:
    """Wait briefly for the result of a guardian that has just begun to act."""
    until_s = time.monotonic() + _RESULT_S
    while run.alive and time.monotonic() < until_s:
        if (result := safe_result_of(run)) and (result.final or result.output == "set"):
            return
        time.sleep(_POLL_S)


def _finish(run: RunFolder, recovered: RecoveredRun) -> None:
    """Remove the folder of a recorded run, or keep it as long as its output is not safe."""
    if recovered.safe or not (run.card.holds and recovered.started):
        run.remove()
        return
    run.keep(recorded=True)
    if (page := _page(run)) is not None:
        page.put(PageField.RECORDED, 1)  # last: its guardian removes the folder from now on
    if not run.alive and _is_settled(run):
        run.remove()


def _page(run: RunFolder) -> SharedPage | None:
    """Return the page of a run; None if its ring is missing or damaged."""
    ring = _ring(run, 0)
    return None if ring is None else ring.page


def _ring(run: RunFolder, number: int) -> SampleRing | None:
    """Return the ring of an axis by its number; None if it is missing or damaged."""
    with suppress(OSError, ValueError):
        return SampleRing(run.ring_of(number))
    return None


def _is_settled(run: RunFolder) -> bool:
    """Return whether the output of a dead run needs no more attention."""
    page = _page(run)
    return page is None or page.is_settled()


def _recover(run: RunFolder) -> list[RecoveredRun]:
    """Finish the recording of each axis of a dead run."""
    page, name, paths = _page(run), run.card.name, run.card.recordings
    if not any(_has_started(page, path) for path in paths):
        for path in paths:
            _remove_claimed(path)
        return [
            RecoveredRun(name, path, True, "nothing has moved", started=False) for path in paths
        ]
    outcome = _DIED if page is None else _outcome_of(page)
    where = "at its safe value" if outcome.safe else "NOT confirmed to be safe: check it"
    text = f"{outcome.reason}; output {where}"
    if page is not None and page.get(PageField.RECORDED):
        return [RecoveredRun(name, path, outcome.safe, text) for path in paths]
    found = []
    for number, path in enumerate(paths):
        lost, kept = _recover_axis(_ring(run, number), page, outcome, path)
        folder = run.path if kept else None
        found.append(RecoveredRun(name, path, outcome.safe, f"{text}; {lost}", folder))
    return found


def _recover_axis(
    ring: SampleRing | None, page: SharedPage | None, outcome: LoopOutcome, path: Path
) -> tuple[str, bool]:
    """Finish the recording of an axis; return what is lost, and whether its ring must be kept.

    ``page`` is that of the run.
    """
    batches: list[BlockBatch] = []
    events: list[Event] = []
    if ring is None or page is None:
        end = {
            "code": _DIED.code,
            "reason": _DIED.reason,
            "output_safe": "false",
            "output_state": _DIED.output,
        }
    else:
        batches = _batches_in(ring, ended=page.observe(PageField.PHASE) == Phase.ENDED)
        events = ring.page.pop_events()
        end = end_facts(outcome, page.lateness(), *ring.page.losses())
    try:
        recovered = recover_recording(path, batches, end, events=events, ended_at=outcome.ended_at)
    except (HilctlError, OSError) as error:
        left = sum(batch.flags.size for batch in batches)
        text = f"{left} samples are only in memory, because its recording could not be recovered"
        return f"{text}: {error}", True
    return f"{recovered.samples} samples: {recovered.reason}", False


def _has_started(page: SharedPage | None, recording: Path) -> bool:
    """Return whether a run had started; the ring is created before its recordings are written."""
    if page is None:
        return not (recording.is_file() and recording.stat().st_size == 0)
    return bool(page.get(PageField.GO) or page.get(PageField.SENT))


def _remove_claimed(recording: Path) -> None:
    """Remove the empty file of a run unless another run uses it."""
    with suppress(OSError), recording.open("rb") as stream:
        if not stream.read(1) and not is_being_recorded(stream):
            recording.unlink()


def _outcome_of(page: SharedPage) -> LoopOutcome:
    """Return how the loop and, after it, the guardian ended."""
    outcome = page.outcome() or _DIED
    if page.observe(PageField.PHASE) == Phase.FAILED:
        outcome = replace(_DIED, reason=page.read_text(PageSlot.ERROR))
    if not page.ended_safely() and (result := page.safe_result()) is not None:
        did = f"guardian: {describe(result.output, result.error)}"
        outcome = replace(outcome, reason=f"{outcome.reason}; {did}", output=result.output)
    return outcome


def _batches_in(ring: SampleRing, *, ended: bool) -> list[BlockBatch]:
    """Return the blocks of a ring, with the one that was under way unless the loop had ended."""
    batches = []
    while True:
        while (batch := ring.pop()) is not None:
            batches.append(batch)
        if not ring.skip_damaged():
            break
    if not ended:
        last = batches[-1].heads[-1] if batches else None
        next_sample = 0 if last is None else int(last[BlockHeader.FIRST_SAMPLE]) + ring.block
        if (unanswered := ring.unanswered(next_sample)) is not None:
            batches.append(unanswered)
    return batches


@contextmanager
def _undisturbed() -> Iterator[None]:
    """Ignore Ctrl-C between a recovered recording and the removal of its folder."""
    if threading.current_thread() is not threading.main_thread():
        yield  # only the main thread receives Ctrl-C and may set handlers
        return
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
