"""Runs whose processes have died: what they left in memory goes into their recordings."""

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

from hilctl.base.errors import HilctlError
from hilctl.base.events import Event
from hilctl.base.samples import Batch, Head
from hilctl.loop.plan import Outcome
from hilctl.recording.recover import recover_recording
from hilctl.run.metadata import end_facts
from hilctl.run.ring import SampleRing
from hilctl.run.run_folder import RunFolder, runs, taken_over
from hilctl.run.shared_page import Field, PageText, Phase


@dataclass(frozen=True, slots=True)
class Orphan:
    """A run that somebody else had to finish.

    Attributes:
        name: The run's name.
        recording: Its recording.
        safe: Whether loop or guardian have put the output at its safe value before they left.
        text: What became of it, for people.
        kept: Folder that still holds what could not be recovered; None where all of it was.
    """

    name: str
    recording: Path
    safe: bool
    text: str
    kept: Path | None = None


def recover_orphans() -> list[Orphan]:
    """Finish the recordings of all dead runs of this user, and clear their folders away."""
    found = []
    for run in runs():
        if run.alive:
            continue
        with taken_over(run) as ours, _undisturbed():
            if ours:
                found.append(orphan := _recover(run))
                if orphan.kept is None:  # else its samples are nowhere but there
                    run.remove()
    return found


def _recover(run: RunFolder) -> Orphan:
    path = Path(run.card.recording)
    outcome, batches, events, end = _left_behind(run)
    where = "at its safe value" if outcome.safe else "NOT known to be safe: look at it"
    try:
        recovered = recover_recording(path, batches, end, events=events, ended_at=outcome.ended_at)
        text = f"{outcome.reason}; output {where}; {recovered.samples} samples: {recovered.reason}"
    except (HilctlError, OSError) as error:
        text = f"{outcome.reason}; output {where}; its recording could not be recovered: {error}"
        return Orphan(run.card.name, path, outcome.safe, text, run.path)
    return Orphan(run.card.name, path, outcome.safe, text)


def _left_behind(
    run: RunFolder,
) -> tuple[Outcome, list[Batch], list[Event], dict[str, str]]:
    """Return how the loop ended, blocks and events that are not safe yet, facts of the end."""
    died = Outcome("fault", "supervisor and loop died", 0, False, 0)
    try:
        ring = SampleRing(run.ring)
    except (OSError, ValueError):
        return died, [], [], {"code": died.code, "reason": died.reason, "output_safe": "false"}
    batches = []
    while True:
        while (batch := ring.pop()) is not None:
            batches.append(batch)
        if not ring.skip_damaged():
            break
    page = ring.page
    outcome = page.outcome() or died
    if page.get(Field.PHASE) == Phase.FAILED:
        outcome = replace(died, reason=page.read_text(PageText.ERROR))
    if page.outcome() is None and (made_safe := page.made_safe()) is not None:
        did = "the guardian put the output at its safe value"
        if not made_safe.confirmed:
            did = f"the guardian could not confirm the safe value: {made_safe.error}"
        outcome = replace(outcome, reason=f"{outcome.reason}; {did}", safe=made_safe.confirmed)
    if page.get(Field.PHASE) != Phase.ENDED:
        last = batches[-1].heads[-1] if batches else None
        next_sample = 0 if last is None else int(last[Head.FIRST_SAMPLE]) + ring.block
        if (unanswered := ring.unanswered(next_sample)) is not None:
            batches.append(unanswered)
    return (
        outcome,
        batches,
        page.pop_events(),
        end_facts(outcome, page.lateness(), page.get(Field.EVENTS_LOST)),
    )


@contextmanager
def _undisturbed() -> Iterator[None]:
    """Let no Ctrl-C come between a recovered recording and the end of its folder."""
    if threading.current_thread() is not threading.main_thread():
        yield  # a Ctrl-C goes to the main thread, and only that may set handlers
        return
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
