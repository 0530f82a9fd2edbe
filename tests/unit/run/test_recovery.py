"""Runs whose processes died: the samples in the ring are recorded, and the folder is removed."""

import json
import os
from dataclasses import asdict
from pathlib import Path

import pytest

from hilctl.base.errors import InputError
from hilctl.loop.safe_output import LoopOutcome
from hilctl.recording.reader import read
from hilctl.run.control.client import status_of
from hilctl.run.recovery import recover_dead_runs
from hilctl.run.run_folder import RunFolder, dismiss, run_folder, runs
from hilctl.run.shared.ring import SampleRing
from hilctl.run.shared.shared_page import (
    GuardianPhase,
    PageField,
    PageSlot,
    Phase,
    SafeActionResult,
)

GOLDEN = Path(__file__).parents[3] / "recordings" / "golden" / "terfenol_uncompensated.mcap"


@pytest.fixture
def dead(tmp_path):
    """Return a function that leaves the folder of a dead run with a given ring.

    With a list for ``guardian`` its lock is held until the test closes the descriptor in it.
    """

    def leave(fill=lambda folder: None, *, holds=(), guardian=None):
        recording = tmp_path / "a.mcap"
        recording.write_bytes(GOLDEN.read_bytes()[:-100])
        with run_folder("sine", {"": recording}, 12.0, holds) as (folder, (lock,)):
            fill(folder)
            folder.keep(recorded=False)
            if guardian is not None:
                guardian.append(os.dup(lock))
        return recording

    return leave


def test_run_without_a_ring_is_not_safe(dead):
    recording = dead()
    (orphan,) = recover_dead_runs()
    assert orphan.recording == recording
    assert not orphan.safe
    assert "NOT confirmed" in orphan.text
    assert read(recording).samples.index.size > 0
    assert runs() == []
    assert recover_dead_runs() == []


def test_outcome_of_a_loop_that_ramped_down_counts(dead):
    def fill(folder):
        page = SampleRing.create(folder.ring, slots=4, block=1, state_size=1).page
        ended = LoopOutcome("stopped", "stopped because the supervisor died", 0, "confirmed")
        page.write_text(PageSlot.OUTCOME, json.dumps(asdict(ended)))
        page.put(PageField.PHASE, Phase.ENDED)
        page.put(PageField.GO, 1)

    dead(fill)
    (orphan,) = recover_dead_runs()
    assert orphan.safe
    assert orphan.text.startswith("stopped because the supervisor died; output at its safe value")


@pytest.mark.parametrize(
    ("error", "words"), [("", "confirmed by the device"), ("no answer", "no answer")]
)
def test_recovery_reports_the_action_of_the_guardian(dead, error, words):
    """Supervisor and loop were dead; an unconfirmed output is not safe."""

    def fill(folder):
        page = SampleRing.create(folder.ring, slots=4, block=1, state_size=1).page
        page.put(PageField.PHASE, Phase.RUNNING)
        page.put(PageField.GO, 1)
        output = "unknown" if error else "confirmed"
        page.leave_safe_result(SafeActionResult(hung=False, output=output, error=error))

    recording = dead(fill)
    (orphan,) = recover_dead_runs()
    assert orphan.safe == (not error)
    assert "; guardian: " in orphan.text
    assert words in orphan.text
    assert ("NOT confirmed" in orphan.text) == bool(error)
    assert read(recording).samples.index.size > 0


HOLDS = ("tcp:10.9.8.7:502",)


def page_of(run):
    return SampleRing(run.ring).page


def unsafe(folder):
    """Leave a ring whose guardian has not yet reached the device."""
    page = SampleRing.create(folder.ring, slots=4, block=1, state_size=1).page
    page.put(PageField.PHASE, Phase.RUNNING)
    page.put(PageField.GO, 1)
    page.put(PageField.GUARDIAN_PHASE, GuardianPhase.ACTING)
    page.leave_safe_result(SafeActionResult(False, "unknown", "no answer", final=False))


def watching(folder):
    unsafe(folder)
    page_of(folder).put(PageField.GUARDIAN_PHASE, GuardianPhase.WATCHING)


def test_a_recording_is_completed_while_the_guardian_acts(dead):
    guardian = []
    recording = dead(unsafe, holds=HOLDS, guardian=guardian)
    (orphan,) = recover_dead_runs()
    assert (orphan.safe, orphan.kept) == (False, None)
    before = recording.read_bytes()
    assert before.endswith(b"\x89MCAP0\r\n")  # complete
    (run,) = runs()
    assert (run.recorded, run.supervised) == (True, False)
    assert page_of(run).get(PageField.RECORDED) == 1  # so that the guardian removes the folder
    assert recover_dead_runs() == []
    assert runs() == [run]
    assert recording.read_bytes() == before
    assert status_of(run)["state"] == "setting the safe value"
    os.close(guardian.pop())


def test_recording_of_a_loop_that_still_ramps_is_not_touched(dead, monkeypatch):
    loops, held = [True], []
    monkeypatch.setattr(RunFolder, "loops", property(lambda run: loops[0]))
    recording = dead(watching, holds=HOLDS, guardian=held)
    before = recording.read_bytes()
    assert recover_dead_runs() == []
    assert recording.read_bytes() == before
    loops[0] = False
    assert len(recover_dead_runs()) == 1
    os.close(held.pop())


@pytest.fixture
def orphan(dead):
    """A recovered run of a real device, whose processes ended before the output was safe."""
    dead(unsafe, holds=HOLDS)
    assert len(recover_dead_runs()) == 1
    (run,) = runs()
    return run


def test_a_dead_run_stays_listed_while_its_output_is_not_safe(orphan):
    for _ in range(2):
        assert recover_dead_runs() == []
        assert runs() == [orphan]
        status = status_of(orphan)
        assert (status["state"], status["output_state"]) == ("dead", "unknown")
        assert orphan.card.name in status["error"]
    dismiss(orphan.card.name)
    assert runs() == []


@pytest.mark.parametrize("settle", [
    lambda page: page.put(PageField.RELIEVED, 1),
    lambda page: page.put(PageField.GUARDIAN_PHASE, GuardianPhase.DONE),
], ids=["relieved", "guardian ended"])  # fmt: skip
def test_dead_run_is_removed_when_its_output_is_safe(orphan, settle):
    settle(page_of(orphan))
    assert recover_dead_runs() == []
    assert runs() == []


def test_a_living_run_is_left_alone(tmp_path):
    with run_folder("sine", {"": tmp_path / "a.mcap"}, 12.0) as (folder, _):
        assert recover_dead_runs() == []
        assert folder.path.is_dir()


def test_folder_that_cannot_be_recovered_is_kept(dead):
    recording = dead()
    cut = recording.read_bytes()
    recording.unlink()
    (orphan,) = recover_dead_runs()
    assert orphan.kept is not None
    assert orphan.kept.is_dir()
    assert "recovered" in orphan.text
    recording.write_bytes(cut)
    (orphan,) = recover_dead_runs()
    assert orphan.kept is None
    assert read(recording).samples.index.size > 0
    assert runs() == []


def ready(folder):
    page = SampleRing.create(folder.ring, slots=4, block=1, state_size=1).page
    page.put(PageField.PHASE, Phase.READY)


@pytest.mark.parametrize("fill", [lambda folder: None, ready])
def test_run_that_never_started_is_removed(dead, fill):
    recording = dead(fill)
    recording.write_bytes(b"")
    (orphan,) = recover_dead_runs()
    assert (orphan.started, orphan.kept) == (False, None)
    assert not recording.exists()
    assert runs() == []


def test_older_recording_of_a_run_that_never_started_is_kept(dead):
    recording = dead(ready)
    before = recording.read_bytes()
    (orphan,) = recover_dead_runs()
    assert not orphan.started
    assert recording.read_bytes() == before
    assert runs() == []


def test_folder_that_cannot_be_recovered_can_be_dismissed(dead, tmp_path):
    dead().unlink()
    (orphan,) = recover_dead_runs()
    dismiss(orphan.name)
    assert runs() == []
    with pytest.raises(InputError, match="named"):
        dismiss(orphan.name)
    for name in ("..", ".", "devices"):
        with pytest.raises(InputError, match="named"):
            dismiss(name)
    with run_folder("sine", {"": tmp_path / "a.mcap"}, 12.0) as (folder, _):
        with pytest.raises(InputError, match="is active"):
            dismiss(folder.card.name)
        assert runs() == [folder]
