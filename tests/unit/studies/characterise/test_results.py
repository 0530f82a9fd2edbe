"""What a campaign says of itself: the held-out error decides, and comes first."""

import json
from dataclasses import replace

import numpy as np
import pytest

from hilctl.identify.data.records import SteadyLoop
from hilctl.identify.fit_api import FitRequest
from hilctl.identify.model_quality import Verdict
from hilctl.identify.pipeline import identify_records
from hilctl.identify.settings import FitSettings
from hilctl.studies.characterise.loops import LoopFigures, ReversalCurves
from hilctl.studies.characterise.noise import RestNoise
from hilctl.studies.characterise.results import (
    Characterisation,
    Measured,
    StepRow,
    ValidationReference,
)

NOTHING = np.empty(0)
UNSEEN = ValidationReference("random reference", 1.5, 0.4, 0.1, 0.2, NOTHING, NOTHING, NOTHING)
LOOP = LoopFigures("sine", 1.0, 0.0, 5.0, -5.0, 5.0, None, 0.0, NOTHING, NOTHING)
FOUND = Characterisation(
    experiment="rig", device="a device", unit="A", band_hz=(1.0, 400.0),
    steps=(StepRow("rest", "noise", 2.0, 0.1),),
    measured=Measured(
        rest=RestNoise(0.0, 0.03, 0.2, 0.0, 50.0, 0.01),
        growing=(LOOP,),
        reversal=ReversalCurves((0.5,), (np.zeros((2, 4)),), 0.01, 0.1),
    ),
    held_out=(UNSEEN,),
)  # fmt: skip


def identification(grade="usable"):
    """Return a straight line through two loops, with a verdict of its own."""
    turns = np.linspace(0.0, 2.0 * np.pi, 60, endpoint=False)
    loops = [SteadyLoop(f"{a} A", a * np.sin(turns), 4.0 * a * np.sin(turns), 1.0) for a in (1, 2)]
    found = identify_records(FitRequest(loops, FitSettings(kind="straight"), "A"))
    reasons = ("units are others",) if grade == "not a model" else ()
    return replace(found, verdict=Verdict(grade, 9.0, False, reasons, ("a note",)))


@pytest.mark.parametrize(
    ("peak", "grade", "text"),
    [
        (1.5, "good", "good: within 1.50 %"),
        (5.0, "usable", "usable within 5.00 %"),
        (30.0, "not a model", "not a model: "),
    ],
)
def test_the_verdict_is_that_of_the_random_reference(peak, grade, text):
    other = replace(UNSEEN, label="other", peak_percent=90.0)
    unseen = (replace(UNSEEN, peak_percent=peak), other)
    found = replace(FOUND, held_out=unseen, identification=identification())
    assert found.verdict.grade == grade
    assert str(found.verdict).startswith(text)
    assert found.is_model is (grade != "not a model")


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
    assert json.loads(text)["verdict"]["grade"] == "good"
    assert json.loads(text)["measured"]["rest"]["noise_um"] == 0.03
    assert "command" not in mapping["measured"]["growing"][0]
    assert "curves" not in mapping["measured"]["reversal"]
    assert mapping["measured"]["reversal"]["turns"] == [0.5]
    assert mapping["rig_time_s"] == 2.0


def test_more_is_known_from_step_to_step():
    more = FOUND.measured.also(growing=(LOOP, LOOP))
    assert (len(more.growing), more.rest) == (2, FOUND.measured.rest)
