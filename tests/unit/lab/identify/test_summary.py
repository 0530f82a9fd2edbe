"""What was found, in rows and lines."""

from dataclasses import replace
from types import SimpleNamespace

import pytest

from hilctl.lab.identify.evaluation import LoopScore, StrokeError
from hilctl.lab.identify.model_quality import Verdict
from hilctl.lab.identify.model_selection import CandidateScore
from hilctl.lab.identify.summary import (
    candidate_table,
    loop_table,
    parameter_texts,
    stroke_table,
    summary,
)
from hilctl.models.base import IdentifiedRange, Provenance


def found(held_out=None, lag_samples=0, starts=(), at_bound=(), known=None):
    fit = SimpleNamespace(
        numbers=7, elapsed_s=1.234, peak_percent=2.5, rms_percent=0.75, own_peak_percent=4.0,
        starts=[SimpleNamespace(rms_percent=each) for each in starts],
        parameters={"a_0": 4.0, "tau_s": 1e-4}, standard_errors={"tau_s": 2e-6}, at_bound=at_bound,
        model=SimpleNamespace(provenance=Provenance(identified_range=known)),
    )  # fmt: skip
    classes = (StrokeError("full stroke", 4.0, 1.0, 1, median_percent=2.0),)
    verdict = Verdict("usable", 4.0, held_out is not None, notes=("one note",), classes=classes)
    return SimpleNamespace(
        fit=fit,
        held_out=held_out,
        lag_samples=lag_samples,
        verdict=verdict,
        candidates=(),
        understood=(),
    )


@pytest.mark.parametrize(("area", "text"), [(None, "-"), (1.5, "+1.50"), (-0.25, "-0.25")])
def test_the_area_s_error_has_a_sign_and_a_history_has_none(area, text):
    headings, (row,) = loop_table([LoopScore("sine", 1.25, 0.5, area, 80.0)])
    assert row == ("sine", "80", "1.25", "0.5", text)
    assert len(row) == len(headings)


def test_a_parameter_stands_with_its_standard_error_where_there_is_one():
    assert parameter_texts(found().fit) == [("a_0", "4"), ("tau_s", "0.0001 ± 2e-06")]


def test_a_parameter_on_a_bound_is_marked():
    shown = found(at_bound=("a_0",))
    assert parameter_texts(shown.fit)[0] == ("a_0", "4 (at its bound)")


def test_starts_that_ended_apart_are_shown_by_their_spread():
    spread = "2 starts ended at rms 0.750 to 0.800 %, in 1.23 s"
    assert summary(found(starts=(0.75, 0.8)))[-1] == spread
    assert summary(found())[-1] == "7 fitted parameters, in 1.23 s"


def test_what_was_not_fitted_comes_before_what_was():
    judgement = SimpleNamespace(peak_percent=3.0, rms_percent=1.0, own_peak_percent=5.0)
    lines = summary(found(SimpleNamespace(judgement=judgement, how="others"), lag_samples=2))
    assert lines[0].startswith("usable within 4 % (median 2 %) at full stroke")
    assert lines[2] == "one note"
    assert lines[3].startswith("not fitted: peak error 3.00 %")
    assert lines[4].startswith("fitted: peak error 2.50 %")
    assert lines[-1] == "lag of the displacements: 2 samples"


def test_the_range_that_it_was_found_for_is_said():
    known = IdentifiedRange(
        peak_to_peak_um=(20.0, 80.0), frequency_hz=(50.0, 50.0), speed_um_per_s=12e3
    )
    line = "identified for 20 to 80 µm peak-to-peak, 50 Hz, up to 1.2e+04 µm/s"
    assert summary(found(known=known))[-1] == line


def test_every_kind_that_was_tried_is_said_with_its_error():
    tried = found()
    tried.candidates = (CandidateScore("kind ppi", 0.5, 2.0, 0.7),)
    assert candidate_table(tried)[1] == [("kind ppi", "0.70", "2.00", "0.50")]


def test_each_stroke_has_its_promise_and_its_grade():
    classes = [StrokeError("full stroke", 1.5, 0.5, 3), StrokeError("half stroke", 4.0, 1.0, 2)]
    classes += [StrokeError("tenth stroke", 11.0, 2.0, 1)]
    verdict = Verdict("poor", 11.0, held_out=True, classes=tuple(classes))
    rows = [row[:3] for row in stroke_table(verdict)[1]]
    assert rows == [
        ("full stroke", "1.5", "good"),
        ("half stroke", "4", "usable"),
        ("tenth stroke", "11", "poor"),
    ]
    guessed = replace(verdict, held_out=False)
    narrow = replace(verdict, grade="usable", classes=tuple(classes[:1]))
    for each in (guessed, narrow):
        assert stroke_table(each)[1][0][2] == "usable"
    assert (verdict.headline.split(":")[0], "validation" in guessed.headline) == ("poor", True)
