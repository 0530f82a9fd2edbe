"""What a recording says of its run."""

import json
from mmap import mmap
from pathlib import Path

from hilctl.base.samples import COLUMNS
from hilctl.loop.pacer import Lateness
from hilctl.loop.plan import Outcome
from hilctl.recording.validation import labels_of
from hilctl.run.metadata import end_facts, experiment_sha256, run_facts
from hilctl.run.shared_page import SIZE, SharedPage
from hilctl.run.start import checked_experiment

EXPERIMENT = Path(__file__).parents[3] / "configs" / "demo.yaml"
OUTCOME = Outcome("stopped", "asked to", 400, "confirmed", 50)
COUNTERS = Lateness(late_ticks=1, skipped_ticks=2, worst_ns=3, worst_tick=4, longest_run=5)
FACTS = {
    "code": "stopped",
    "reason": "asked to",
    "output_safe": "true",
    "output_state": "confirmed",
    "late_ticks": "1",
    "skipped_ticks": "2",
    "worst_late_ns": "3",
    "worst_late_tick": "4",
    "longest_late_run": "5",
    "dropped_in_ring": "50",
}


def test_end_has_every_counter() -> None:
    """Wherever a run's counters stand, its end says the same of them."""
    assert end_facts(OUTCOME, COUNTERS) == {**FACTS, "lost_events": "0"}
    page = SharedPage(mmap(-1, SIZE))
    page.leave_lateness(COUNTERS)
    assert end_facts(OUTCOME, page.lateness(), 6) == {**FACTS, "lost_events": "6"}


def test_every_column_has_its_unit() -> None:
    """Under the name that it is recorded by."""
    facts = run_facts(checked_experiment(EXPERIMENT, []), "2000-01-01T00:00:00", "model: x\n")
    units = json.loads(facts["units"])
    assert set(units) == {"t_rel", *(column.field("A").name for column in COLUMNS.values())}
    assert (units["current_a"], units["displacement_um"]) == ("A", "um")
    assert len(facts["model_sha256"]) == 64


def test_labels_are_recorded_and_change_no_identity() -> None:
    """A campaign that goes on with another operator measures nothing twice."""
    plain = checked_experiment(EXPERIMENT, [])
    labelled = checked_experiment(EXPERIMENT, ["labels={sample: A7, t: 21.5}"])
    facts = run_facts(labelled, "2000-01-01T00:00:00", "")
    assert labels_of(facts) == {"sample": "A7", "t": 21.5}
    assert facts["experiment_sha256"] == experiment_sha256(plain.loaded)
    other = checked_experiment(EXPERIMENT, ["waveform.phase_deg=1.0"])
    assert experiment_sha256(other.loaded) != experiment_sha256(plain.loaded)
