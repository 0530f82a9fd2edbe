"""What is wrong with data is said; what cannot be known from them is not promised."""

from dataclasses import replace

import numpy as np
import pytest

from hilctl.base.errors import DataError
from hilctl.lab.identify import pipeline
from hilctl.lab.identify.data.records import History
from hilctl.lab.identify.fit_api import FitRequest
from hilctl.lab.identify.model_selection import alike_loops
from hilctl.lab.identify.pipeline import as_recorded, as_run, identify_records
from hilctl.lab.identify.settings import FitSettings
from hilctl.models.model_file import dump_model, parse_model
from hilctl.models.plays import PpiModel

TRUTH = PpiModel(direct=4.0, weights=(1.0, 2.0), thresholds=(2.0, 4.0))
GRID = [(a, f) for a in (2.0, 4.0, 6.0) for f in (10.0, 50.0, 100.0)]


@pytest.fixture
def grid(loop_of):
    return [loop_of(TRUTH, a, f) for a, f in GRID]


def judged(records, validate=(), **choices):
    chosen = {"plays": 2, "starts": 1, "weights": "free", **choices}
    return identify_records(
        FitRequest(records, FitSettings(kind="ppi", **chosen), validate=validate)
    )


def changed(records, change):
    return [replace(each, displacement_um=change(each.displacement_um)) for each in records]


def test_a_model_that_holds_on_what_it_did_not_see_is_good(grid):
    found = judged(grid)
    assert found.verdict.grade == "good"
    assert found.verdict.within_percent < 1.0
    assert not found.verdict.notes
    assert found.held_out.how.startswith("8 of 9 loops")
    by_stroke = found.fit.model.provenance.errors_by_stroke
    assert by_stroke == {each.label: each.peak_percent for each in found.verdict.classes}
    assert found.verdict.within_percent == max(by_stroke.values())
    provenance = found.fit.model.provenance
    for each in found.verdict.classes:
        assert provenance.median_by_stroke[each.label] == each.median_percent <= each.peak_percent
        assert each.worst in provenance.worst_by_stroke[each.label]


def test_motions_above_the_highest_frequency_of_use_do_not_count(grid):
    """A loop at 100 Hz may be far off in a model for up to 50 Hz."""
    far = [
        replace(each, displacement_um=2.0 * each.displacement_um)
        if each.frequency_hz == 100.0
        else each
        for each in grid
    ]
    assert judged(far, grid).verdict.grade in {"poor", "not a model"}
    found = judged([*grid[0::3], *grid[1::3]], far, highest_hz=50.0)
    assert found.verdict.grade == "good"
    assert found.fit.model.provenance.identified_range.frequency_hz == (10.0, 50.0)
    assert judged(grid, highest_hz=70.0).fit.model.provenance.identified_range.frequency_hz[1] == 70
    with pytest.raises(DataError, match="highest_hz=5"):
        judged(grid, highest_hz=5.0)


def test_an_error_on_what_was_not_fitted_decides(grid):
    others = changed(grid[3:4], lambda y: y + 0.1 * np.ptp(y))
    verdict = judged(grid, others).verdict
    assert verdict.grade == "poor"
    assert verdict.within_percent == pytest.approx(10.0, abs=0.5)
    far = judged(grid, changed(grid[:1], lambda y: y + 0.3 * np.ptp(y))).verdict
    assert far.grade == "not a model"
    assert "'sine 2 A 10 Hz'" in str(far)


def test_motions_smaller_than_half_of_the_stroke_do_not_change_the_grade(grid):
    small = changed(grid[:1], lambda y: y + 0.1 * np.ptp(y))
    verdict = judged(grid, small).verdict
    assert verdict.grade == "good"
    assert {each.label: round(each.worst_percent) for each in verdict.classes} == {
        "full stroke": 0,
        "half stroke": 0,
        "quarter stroke": 10,
    }


def dead(y):
    return np.random.default_rng(y.size).normal(0.0, 0.05, y.size)


@pytest.mark.parametrize(("change", "reason"), [
    (dead, "explains 0 %"),
    (lambda y: 1000.0 * y, "in nm"),
    (lambda y: -y, "swap the wires"),
    (np.abs, "--model butterfly"),
])  # fmt: skip
def test_data_that_are_no_actuator_s_are_refused_with_the_reason(grid, change, reason):
    verdict = judged(changed(grid, change)).verdict
    assert verdict.grade == "not a model"
    assert reason in str(verdict)


def test_swapped_columns_are_seen_by_what_comes_first(grid):
    swapped = [replace(r, command=r.displacement_um, displacement_um=r.command) for r in grid]
    assert "leads the command" in str(judged(swapped).verdict)


def test_one_record_in_other_units_is_named(grid):
    odd = [*grid[:4], *changed(grid[4:5], lambda y: y / 1000.0), *grid[5:]]
    assert "'sine 4 A 50 Hz' has 0.00" in str(judged(odd).verdict)


@pytest.mark.parametrize(
    ("chosen", "note"),
    [(slice(0, 1), "--validate"), (slice(0, None, 3), "10 Hz"), (slice(0, 3), "one amplitude")],
)
def test_what_a_campaign_can_t_know_is_said_and_nothing_is_good(grid, chosen, note):
    verdict = judged(grid[chosen]).verdict
    assert verdict.grade == "usable"
    assert any(note in each for each in verdict.notes)


def test_loops_about_one_command_are_good_for_a_ppi_at_most(grid):
    settings = FitSettings(kind="rdpi", plays=3, starts=1, weight_by="equal")

    def verdict(records):
        return identify_records(FitRequest(records, settings, "A")).verdict

    central = verdict(grid)
    assert central.grade == "usable"
    assert any("other middles" in note for note in central.notes)
    small = grid[0]
    moved = replace(
        small, command=small.command + 3.0, displacement_um=small.displacement_um + 18.0
    )
    aside = verdict([*grid, moved])
    assert not any("other middles" in note for note in aside.notes)


def test_the_cause_of_an_error_is_named_before_a_model_is_poor(grid):
    clipped = changed(grid, lambda y: np.minimum(y, 29.2))
    verdict = judged(clipped).verdict
    assert verdict.grade == "usable"
    assert "end of its range" in verdict.notes[0]


def test_an_offset_is_suggested_where_the_error_is_one(grid):
    moved = changed(grid, lambda y: y + 4.0)
    verdict = judged(moved).verdict
    assert any("offset=true" in note for note in verdict.notes)
    assert not judged(moved, offset=True).verdict.notes


def test_the_last_part_of_a_history_is_held_out():
    time_s = np.arange(4000) / 1000.0
    command = 5.0 * np.sin(2.0 * np.pi * 5.0 * time_s) * np.cos(2.0 * np.pi * 0.5 * time_s)
    displacement_um = TRUTH.forward(1000.0).process(command)
    displacement_um[3500:] += 5.0
    found = judged([History("beat", command, displacement_um, 1000.0)])
    assert found.held_out.records[0].ignore == 2800
    assert found.held_out.judgement.own_peak_percent == pytest.approx(
        500.0 / np.ptp(displacement_um[2800:]), rel=0.1
    )
    assert np.max(np.abs(found.held_out.judgement.modelled_um[0])) > 20.0


@pytest.mark.parametrize(("command", "one_amplitude", "one_frequency"), [
    (lambda t: np.sin(20.0 * np.pi * t), True, True),
    (lambda t: np.sin(20.0 * np.pi * t) * (1.0 + t), False, True),
    (lambda t: np.sin(20.0 * np.pi * t * (1.0 + t)), True, False),
    (lambda t: np.sin(20.0 * np.pi * t) + 0.5 * np.sin(47.0 * np.pi * t), False, False),
])  # fmt: skip
def test_a_history_of_one_amplitude_or_frequency_tells_nothing_of_others(
    command, one_amplitude, one_frequency
):
    t = np.arange(4000) / 2000.0
    noise = 0.0005 * np.random.default_rng(3).standard_normal(t.size)
    history = History("h", command(t) + noise, command(t), 2000.0)
    found = list(alike_loops([history]))
    assert len(found) == one_amplitude + one_frequency
    assert any(" Hz" in text for text in found) == one_frequency


def test_one_frequency_or_amplitude_is_good_for_a_ppi_at_most():
    time_s = np.arange(4000) / 1000.0
    for command in (np.sin(10.0 * time_s), np.sin(10.0 * time_s) * (3.0 - 0.5 * time_s)):
        displacement_um = TRUTH.forward(1000.0).process(5.0 * command)
        history = History("sine", 5.0 * command, displacement_um, 1000.0)
        assert judged([history], plays=6).verdict.grade == "good"
        for kind in ("rdpi", "integrated"):
            settings = FitSettings(kind=kind, plays=4, starts=1, weight_by="equal")
            verdict = identify_records(FitRequest([history], settings, "A")).verdict
            assert verdict.grade != "good"
            assert any("at other frequencies" in note for note in verdict.notes)


def written_percent(model, record):
    """Return the largest error of a model as written, of the whole motion."""
    read = parse_model("model.yaml", dump_model(model))
    error_um = read.forward(record.sample_rate_hz).process(record.command) - record.displacement_um
    return 100.0 * np.max(np.abs(error_um)) / np.ptp(record.displacement_um)


def test_the_promise_includes_creep_that_the_model_does_not_have():
    time_s = np.arange(4000) / 1000.0
    command = (6.0 - time_s) * np.sin(4.0 * np.pi * time_s)
    record = History("h", command, TRUTH.forward(1000.0).process(command), 1000.0)
    crept_um = record.displacement_um + 3.0 * np.log1p(time_s / 0.1)
    found = judged([record], [replace(record, displacement_um=crept_um)], creep=True)
    assert found.held_out.judgement.own_peak_percent < 2.0
    (full,) = (each for each in found.verdict.classes if each.label == "full stroke")
    written = written_percent(found.fit.model, found.held_out.records[0])
    assert written > 8.0
    assert full.worst_percent == pytest.approx(written, rel=0.5)


def test_the_promise_includes_a_lag_that_the_model_does_not_have():
    time_s = np.arange(4000) / 200.0
    command = (6.0 - 0.2 * time_s) * np.sin(2.0 * np.pi * time_s)
    displacement_um = TRUTH.forward(200.0).process(command)
    late = replace(
        History("h", command, displacement_um, 200.0), displacement_um=np.roll(displacement_um, 4)
    )
    request = FitRequest([late], FitSettings(kind="ppi", plays=2, starts=1, weights="free"))
    shifted = identify_records(replace(request, records=[late.without_lag(4)]))
    assert shifted.verdict.grade == "good"
    found = as_recorded(shifted, request, 4)
    assert found.verdict.grade == "poor"
    assert "table.lag_samples=4" in found.verdict.notes[0]
    errors = found.fit.model.provenance.errors_by_stroke
    assert errors == {each.label: each.peak_percent for each in found.verdict.classes}
    assert errors["full stroke"] == pytest.approx(written_percent(found.fit.model, late), rel=0.3)
    assert as_recorded(shifted, request, 0) is shifted


def test_the_promise_includes_the_motion_from_rest_to_the_loops(grid):
    """Steady cycles do not show an offset that the first cycles have."""
    found = judged(grid)
    time_s = np.arange(2000) / 1000.0
    command = 6.0 * np.sin(20.0 * np.pi * time_s)
    displacement_um = TRUTH.forward(1000.0).process(command)
    settings = FitSettings(kind="ppi")
    same = as_run(found, [History("run", command, displacement_um, 1000.0)], settings)
    assert same.verdict.grade == "good"
    crept_um = displacement_um + 16.0 * np.exp(-time_s / 0.5)
    later = as_run(found, [History("run", command, crept_um, 1000.0)], settings)
    assert later.verdict.grade == "poor"
    provenance = later.fit.model.provenance
    assert provenance.errors_by_stroke["full stroke"] == later.verdict.within_percent > 5.0
    assert "'run'" in provenance.worst_by_stroke["full stroke"]


def test_a_structure_at_a_bound_is_left_out_or_its_worth_is_said(monkeypatch):
    time_s = np.arange(4000) / 1000.0
    command = (6.0 - time_s) * np.sin(4.0 * np.pi * time_s)
    record = History("h", command, TRUTH.forward(1000.0).process(command), 1000.0)
    settings = FitSettings(kind="field", plays=4, cells=6, knots=6)
    held_out = pipeline.held_out_error
    fit_model = pipeline.fit_model
    request = FitRequest([record], settings)
    monkeypatch.setattr(
        pipeline,
        "fit_model",
        lambda asked: replace(
            fit_model(asked), at_bound=("natural_hz",) if asked.settings.structure else ()
        ),
    )
    found = identify_records(request)
    assert "natural_hz" not in found.fit.parameters

    def worse(asked):
        error = held_out(asked)
        rms = 9.0 if asked.settings.structure is False else 1.0
        classes = tuple(replace(each, rms_percent=rms) for each in error.judgement.classes)
        return replace(error, judgement=replace(error.judgement, classes=classes))

    monkeypatch.setattr(pipeline, "held_out_error", worse)
    found = identify_records(request)
    assert "natural_hz" in found.fit.parameters
    assert found.verdict.notes[-1].endswith("1 %, and 9 % without the structure")
