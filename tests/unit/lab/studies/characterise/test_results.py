"""Verdict, model and validation."""

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from hilctl.base.segments import Segment
from hilctl.lab.identify.data.records import History, SteadyLoop
from hilctl.lab.identify.fit_api import FitRequest
from hilctl.lab.identify.model_quality import Verdict
from hilctl.lab.identify.pipeline import identify_records
from hilctl.lab.identify.settings import FitSettings
from hilctl.lab.response.segment_spectrum import rest_noise
from hilctl.lab.studies.characterise import results
from hilctl.lab.studies.characterise.measurements import LoopMetrics, ReversalCurves
from hilctl.lab.studies.characterise.results import (
    FITTED,
    VALIDATED,
    Characterisation,
    Measured,
    StepRow,
    ValidationReference,
    validate,
)
from hilctl.lab.studies.characterise.steps import STEPS
from hilctl.models.linear_stages import FirstMode, FurtherMode
from hilctl.models.plays import PpiModel
from tests.unit.lab.response.test_bode import SMALL

NOTHING = np.empty(0)
MODE = FurtherMode(
    natural_hz=900.0, damping_ratio=0.02, antiresonance_hz=800.0, antiresonance_damping_ratio=0.02
)
UNSEEN = ValidationReference("random reference", 1.5, 0.4, 0.1, 0.2, *[NOTHING] * 4)
LOOP = LoopMetrics("sine", 1.0, 0.0, 5.0, -5.0, 5.0, None, 0.0, NOTHING, NOTHING)
FOUND = Characterisation(
    experiment="rig", device="a device", unit="A", band_hz=(1.0, 400.0),
    steps=(StepRow("rest", "noise", 2.0, 0.1),),
    measured=Measured(
        rest=replace(rest_noise(np.arange(16.0), 5000.0), noise_um=0.03),
        small=replace(SMALL, further=(MODE,)),
        growing=(LOOP,),
        reversal=ReversalCurves((0.5,), (np.zeros((2, 4)),), 0.01, 0.1),
    ),
    held_out=(UNSEEN,),
)  # fmt: skip


def identification(grade="usable"):
    """Return the identification of a straight line, with a given verdict."""
    turns = np.linspace(0.0, 2.0 * np.pi, 60, endpoint=False)
    loops = [SteadyLoop(f"{a} A", a * np.sin(turns), 4.0 * a * np.sin(turns), 1.0) for a in (1, 2)]
    found = identify_records(FitRequest(loops, FitSettings(kind="straight"), "A"))
    reasons = ("units are others",) if grade == "not a model" else ()
    return replace(found, verdict=Verdict(grade, 9.0, False, reasons, ("a note",)))


@pytest.mark.parametrize(
    ("off_percent", "grade"), [(1.5, "good"), (4.5, "usable"), (6.0, "poor"), (30.0, "not a model")]
)
def test_the_verdict_follows_the_errors_by_stroke_of_the_validation(
    run, monkeypatch, off_percent, grade
):
    known = identification()
    known = replace(known, fit=replace(known.fit, model=MODEL))
    moved_um = float(np.ptp(run().samples.displacement_um))
    monkeypatch.setattr(results, "read", lambda path: run(0.01 * off_percent * moved_um))
    found, references = results.validated(known, {name: Path() for name in VALIDATED}, 0.0)
    assert found.verdict.grade == grade
    assert [reference.label for reference in references] == list(VALIDATED.values())
    by_stroke = found.fit.model.provenance.errors_by_stroke
    assert by_stroke == {each.label: each.peak_percent for each in found.verdict.classes}


def test_data_that_no_model_fits_are_not_saved_by_one_reference():
    found = replace(FOUND, identification=identification("not a model"))
    assert found.verdict.reasons == ("units are others",)
    assert not found.is_model


def test_without_a_model_there_is_no_verdict():
    assert FOUND.verdict is None
    assert not FOUND.is_model
    assert replace(FOUND, held_out=(), identification=identification()).verdict is None


def test_json_begins_with_the_held_out_error_and_has_no_signals():
    mapping = replace(FOUND, identification=identification()).to_mapping()
    assert next(iter(mapping)) == "held_out"
    text = json.dumps(mapping, allow_nan=False)
    assert json.loads(text)["verdict"]["grade"] == "usable"
    assert json.loads(text)["measured"]["rest"]["noise_um"] == 0.03
    assert json.loads(text)["measured"]["small"]["further"] == [MODE.model_dump()]
    assert "command" not in mapping["measured"]["growing"][0]
    assert "curves" not in mapping["measured"]["reversal"]
    assert mapping["measured"]["reversal"]["turns"] == [0.5]
    assert mapping["rig_time_s"] == 2.0


MODEL = PpiModel(direct=3.0, thresholds=(0.5,), weights=(2.0,), input_range=(-1.0, 1.0))
RATE_HZ = 1000.0


@pytest.fixture
def run(make_recording):
    """A conditioning cycle, then a reference that is evaluated between 600 and 1900."""

    def make(off_um=0.0, reach=1.0, rest=0.0):
        command = reach * np.sin(np.arange(2000) ** 1.5 / 900.0)
        command[0] = rest
        moved = MODEL.forward(RATE_HZ).process(command) + off_um
        segments = [Segment("decaying", 0, 500, 0, 500), Segment("random", 500, 2000, 600, 1900)]
        return make_recording(moved, command=command, segments=segments, sample_rate_hz=RATE_HZ)

    return make


def test_what_is_judged_is_not_fitted():
    names = [step.name for step in STEPS]
    assert set(VALIDATED) <= set(names)
    assert set(FITTED) <= set(names)
    assert not set(FITTED) & set(VALIDATED)


def test_a_perfect_model_has_no_error(run):
    found = validate(MODEL, run(), 0.0, "random reference")
    assert found.peak_percent < 1e-9
    assert found.label == "random reference"
    assert (found.time_s[0], found.time_s.size) == (0.6, 1300)


def test_an_offset_is_an_error_and_is_told_apart(run):
    found = validate(MODEL, run(-0.5), 0.0, "x")
    errors = (found.peak_percent, found.mean_percent, found.rms_percent)
    assert errors == pytest.approx((50.0 / np.ptp(found.measured_um),) * 3)


def test_the_floor_is_what_noise_makes(run):
    """The largest of 1300 normal values is about 3.4 standard deviations."""
    found = validate(MODEL, run(), 0.01, "x")
    assert found.floor_percent == pytest.approx(3.4 / np.ptp(found.measured_um), rel=0.05)


def test_commands_that_the_model_was_not_found_on_are_not_judged(run):
    assert validate(MODEL, run(reach=1.5), 0.0, "x").time_s.size < 1000


def test_the_kind_is_chosen_on_whole_histories_of_what_may_be_fitted(run, monkeypatch):
    """Histories end with the last waveform at full amplitude, with gaps filled."""
    asked = []

    def identify(request):
        asked.append(request)
        return "found"

    monkeypatch.setattr(results, "identify_records", identify)
    monkeypatch.setattr(results, "read", lambda path: run())
    paths = {name: Path(f"{name}.mcap") for name in [*FITTED, *VALIDATED, "growing-1"]}
    structure = FirstMode(natural_hz=900.0, damping_ratio=0.1)
    small = SimpleNamespace(structure=structure, further=(MODE,))
    assert results.identified(paths, Measured(small=small)) == "found"
    (request,) = asked
    assert request.structure == structure
    assert (request.settings.structure, request.modes) == (True, (MODE,))
    records, settings, unit = request.records, request.settings, request.unit
    assert len(records) == len(request.source) == len(FITTED)
    assert (settings.auto, settings.whole, unit) == (True, True, "A")
    assert all(isinstance(record, History) for record in records)
    assert all(record.command.size == 1900 for record in records)
    # What happened before the first motion over the range does not count.
    ends = [np.argmin(run().samples.command[:500]), np.argmax(run().samples.command[:500])]
    assert all(record.ignore == max(ends) for record in records)
    monkeypatch.setattr(results, "read", lambda path: run(rest=-1.0))
    results.identified(paths, Measured(small=SimpleNamespace(structure=None, further=())))
    assert not asked[-1].settings.structure
    first = run(rest=-1.0).samples.command[:500]
    assert all(record.ignore == np.argmax(first) > 0 for record in asked[-1].records)
