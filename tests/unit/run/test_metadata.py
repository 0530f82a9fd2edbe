"""Metadata of a run in its recording."""

import hashlib
import json
from dataclasses import replace
from itertools import pairwise
from mmap import mmap
from pathlib import Path

import numpy as np
import pytest

from hilctl.analysis.report import summarize
from hilctl.base.events import TUNED, Event
from hilctl.base.samples import COLUMNS, Flag
from hilctl.base.segments import Segment
from hilctl.loop.pacer import Lateness
from hilctl.loop.safe_output import LoopOutcome
from hilctl.recording.metadata_keys import END_FIGURES
from hilctl.recording.reader import read
from hilctl.recording.validation import labels_of
from hilctl.run.metadata import (
    EndFigures,
    RunDescription,
    SettingRow,
    end_facts,
    experiment_sha256,
    run_facts,
    setting_rows,
)
from hilctl.run.shared.shared_page import SIZE, SharedPage
from hilctl.run.start import checked_experiment

EXPERIMENT = Path(__file__).parents[3] / "configs" / "demo.yaml"
OUTCOME = LoopOutcome("stopped", "asked to", 400, "confirmed")
COUNTERS = Lateness(
    late_ticks=1, skipped_ticks=2, worst_ns=3, worst_tick=4, longest_run=5, mean_wake_ns=6
)
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
    "mean_wake_ns": "6",
    "dropped_in_ring": "50",
}


def test_end_has_every_counter():
    assert end_facts(OUTCOME, COUNTERS, 50) == {**FACTS, "lost_events": "0"}
    page = SharedPage(mmap(-1, SIZE))
    page.leave_lateness(COUNTERS)
    assert end_facts(OUTCOME, page.lateness(), 50, 6) == {**FACTS, "lost_events": "6"}


def test_every_column_has_its_unit():
    facts = run_facts(checked_experiment(EXPERIMENT, []), "2000-01-01T00:00:00", "model: x\n")
    units = json.loads(facts["units"])
    assert set(units) == {"t_rel", *(column.field("A").name for column in COLUMNS.values())}
    assert (units["current_a"], units["displacement_um"]) == ("A", "um")
    assert len(facts["model_sha256"]) == 64


def test_labels_are_recorded_and_change_no_identity():
    plain = checked_experiment(EXPERIMENT, [])
    labelled = checked_experiment(EXPERIMENT, ["labels={sample: A7, t: 21.5}"])
    facts = run_facts(labelled, "2000-01-01T00:00:00", "")
    assert labels_of(facts) == {"sample": "A7", "t": 21.5}
    assert facts["experiment_sha256"] == experiment_sha256(plain.loaded)
    other = checked_experiment(EXPERIMENT, ["waveform.phase_deg=1.0"])
    assert experiment_sha256(other.loaded) != experiment_sha256(plain.loaded)


CONFIGS = Path(__file__).parents[3] / "configs"


def test_timeout_of_the_device_changes_no_identity():
    loaded = [
        checked_experiment(CONFIGS / "modbus_labjack_t7.yaml", settings).loaded
        for settings in ([], ["device.timeout_s=1.0"], ["device.tcp_port=503"])
    ]
    first, patient, elsewhere = map(experiment_sha256, loaded)
    assert first == patient != elsewhere


def test_profiles_have_hashes():
    checked = checked_experiment(CONFIGS / "modbus_adam_6224.yaml", [])
    facts = run_facts(checked, "2000-01-01T00:00:00", "")
    files = checked.loaded.device.info.files
    for name in ("profile", "reader_profile"):
        text = files[f"{name}.yaml"]
        assert facts[f"device.{name}_sha256"] == hashlib.sha256(text.encode()).hexdigest()


def test_description_has_the_values_of_the_experiment(tmp_path):
    given = RunDescription.of(checked_experiment(CONFIGS / "demo.yaml", []))
    given.write(tmp_path / "description.json")
    seen = RunDescription.read(tmp_path / "description.json")
    assert seen == given
    assert (seen.sample_rate_hz, seen.block, seen.command_unit) == (50000.0, 50, "A")
    assert (seen.waveform_unit, seen.samples) == ("um", 500000)
    assert seen.limits.command == [-7.07, 7.07]
    assert [(each.start, each.period) for each in seen.segments_at(100)] == [(100, 1000.0)]
    assert SettingRow(key="waveform.frequency_hz", value="50.0", settable=True) in seen.settings


def test_settings_are_dotted_and_nested_sequences_are_changed_in_the_file():
    rows = setting_rows({"a": {"b": 1, "c": (2.0, 3.0)}, "steps": ({"x": 1}, {"x": 2})})
    assert [(row.key, row.value, row.settable) for row in rows] == [
        ("a.b", "1", True),
        ("a.c", "[2.0, 3.0]", True),
        ("steps", "2 entries", False),
    ]


def test_description_of_another_version_is_refused(tmp_path):
    (tmp_path / "description.json").write_text('{"name": "x"}')
    with pytest.raises(ValueError, match="sample_rate_hz"):
        RunDescription.read(tmp_path / "description.json")


GOLDEN = Path(__file__).parents[3] / "recordings" / "golden"
TWO = (Segment("a", 0, 3000, 100, 3000, 500.0), Segment("b", 3000, 6000, 3000, 5500, 500.0))
ONCE = (Segment("once", 0, 6000, 1000, 5000),)
FAST = (Segment("too fast for a loop", 0, 6000, 0, 6000, 2.0),)
LONG = (Segment("less than a cycle", 0, 6000, 0, 6000, 9000.0),)


def gathered(recording, pieces=7, events=()):
    """Return the facts from the samples of a recording, in pieces."""
    figures = EndFigures(recording.segments, compensated=recording.compensated)
    rows = recording.samples.index.size
    bounds = np.linspace(0, rows, pieces + 1).astype(int)
    for start, stop in pairwise(bounds):
        figures.add(recording.samples.rows(slice(start, stop)))
    for event in events:
        figures.event(event)
    return {name: float(text) for name, text in figures.facts().items()}


def reported(recording):
    """Return the same metrics of a report, except missing ones."""
    report = summarize(recording).to_mapping()
    return {name: report[name] for name in END_FIGURES if report[name] is not None}


@pytest.mark.parametrize("name", ["terfenol_compensated", "terfenol_uncompensated"])
@pytest.mark.parametrize("segments", [(), TWO, ONCE, FAST, LONG])
@pytest.mark.parametrize("pieces", [1, 500])
def test_end_metrics_are_those_of_the_report(name, segments, pieces):
    recording = read(GOLDEN / f"{name}.mcap")
    samples = recording.samples.rows(recording.samples.index % 1000 > 3)
    samples.displacement_um[40::997] = np.nan
    samples.displacement_um[41::997] = 1e9
    samples.flags[41::997] |= Flag.SENSOR_INVALID.value
    chosen = replace(recording, samples=samples, segments=segments or recording.segments)
    found = gathered(chosen, pieces)
    assert found == pytest.approx(reported(chosen), rel=1e-9)
    assert bool(found) == (segments not in (FAST, LONG))


def test_truncated_segment_has_no_metrics():
    recording = replace(read(GOLDEN / "terfenol_compensated.mcap"), segments=TWO)
    cut = replace(recording, samples=recording.samples.part(0, TWO[1].steady_stop - 1))
    first = replace(recording, segments=TWO[:1])
    assert gathered(cut) == pytest.approx(reported(first))
    assert gathered(replace(cut, samples=cut.samples.part(0, 2999))) == {}


@pytest.mark.parametrize(
    ("at", "takes", "counts"), [(50, 50, True), (50, 51, False), (2999, 1, False), (5900, 9, True)]
)
def test_tuned_segment_has_no_metrics(at, takes, counts):
    segments = (Segment("a", 0, 6000, 100, 5000, 500.0),)
    recording = replace(read(GOLDEN / "terfenol_compensated.mcap"), segments=segments)
    change = Event(at, "info", TUNED, "", {"gain": 0.5, "offset": 0.0, "samples": float(takes)})
    assert bool(gathered(recording, events=[change])) == counts


def test_samples_of_the_ramp_belong_to_no_segment():
    """A stopped run ramps to the safe value within the times of its segment."""
    recording = read(GOLDEN / "terfenol_compensated.mcap")
    samples = recording.samples
    samples.flags[samples.index >= 4000] |= Flag.RAMP.value
    assert gathered(recording) == {}


@pytest.mark.filterwarnings("error")
def test_largest_numbers_cause_no_warning():
    recording = read(GOLDEN / "terfenol_compensated.mcap")
    recording.samples.displacement_um[::2] = 1.7e308
    recording.samples.displacement_um[1::2] = -1.7e308
    for segments in (recording.segments, ONCE):
        assert gathered(replace(recording, segments=segments))
