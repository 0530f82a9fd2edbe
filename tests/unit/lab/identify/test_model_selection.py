"""Choice of kind, size and lag by held-out data."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from hilctl.base.errors import DataError
from hilctl.lab.identify import model_selection
from hilctl.lab.identify.data.records import History, Record, SteadyLoop
from hilctl.lab.identify.evaluation import Evaluation, StrokeError
from hilctl.lab.identify.fit_api import FitRequest, ignore_progress
from hilctl.lab.identify.fit_model import fit_model
from hilctl.lab.identify.model_selection import (
    LOOPS,
    CandidateScore,
    HeldOut,
    choose_lag,
    folds_of,
    select,
)
from hilctl.lab.identify.pipeline import settings_from
from hilctl.lab.identify.settings import FitSettings
from hilctl.models.plays import PpiModel

MODEL = PpiModel(direct=4.0, weights=(1.0,), thresholds=(0.5,))
GRID = [(a, f) for a in (2.0, 4.0, 6.0) for f in (10.0, 50.0, 100.0)]


@pytest.fixture
def grid(loop_of):
    return [loop_of(MODEL, a, f) for a, f in GRID]


def history(envelope):
    command = envelope * np.sin(0.05 * np.arange(1000))
    return History("h", command, 5.0 * command, 1000.0, ignore=100)


def test_no_fit_sees_what_it_is_judged_on_and_each_loop_is_judged_once(grid):
    folds = folds_of(grid)
    for fold in folds:
        seen = {id(record) for record in fold.fitted}
        assert not seen & {id(record) for record in fold.held_out}
        assert len(fold.fitted) + len(fold.held_out) == len(grid)
    out = [id(record) for fold in folds for record in fold.held_out]
    assert len(out) == len(set(out)) >= 6


def test_what_reaches_furthest_is_never_held_out(grid):
    """The fastest and largest loop alone says how fast and far the model holds."""
    held_out = [record.label for fold in folds_of(grid) for record in fold.held_out]
    assert grid[-1].label not in held_out


def test_of_three_loops_none_is_left_out(grid):
    assert folds_of(grid[:3]) == []


def test_of_a_history_the_last_part_of_what_is_judged_is_held_out():
    whole = history(np.linspace(1.0, 0.5, 1000))
    (fold,) = folds_of([whole])
    assert fold.fitted[0].command.size == fold.held_out[0].ignore == 730
    np.testing.assert_array_equal(fold.held_out[0].command, whole.command)


def test_a_history_that_grows_has_no_part_that_says_anything_of_the_rest():
    assert folds_of([history(np.linspace(0.5, 1.0, 1000))]) == []


def test_histories_that_grow_are_held_out_as_wholes_or_the_validation_is():
    small, large = (history(scale * np.linspace(0.5, 1.0, 1000)) for scale in (0.5, 1.0))
    (fold,) = folds_of([small, large])
    assert fold.fitted == (large,)
    assert fold.held_out == (small,)
    (fold,) = folds_of([large], [small])
    assert fold.held_out == (small,)


def test_a_step_after_skipped_ticks_is_no_faster_motion():
    record = history(np.ones(1000))
    skipped = np.array([879, 880])  # the command crosses 0
    record.command[skipped] = record.command[878]
    assert folds_of([record]) == []
    assert len(folds_of([replace(record, held=skipped)])) == 1


def test_a_history_that_rests_at_its_end_is_fitted_as_a_whole():
    """Errors in percent of the little that a rest moves by would say nothing."""
    envelope = np.where(np.arange(1000) < 650, 1.0, 0.02)
    assert folds_of([history(envelope)]) == []


WAVE = np.sin(np.linspace(0.0, 6.0, 64))
HISTORY = History("history", WAVE, 9.0 * WAVE, 100.0)
LOOP = SteadyLoop("loop", WAVE, 9.0 * WAVE, 1.0)


SMALL = {"field 8": 0.3, "generalised_duhem 12": 0.5, "field 32": 0.15}


def fake(monkeypatch: pytest.MonkeyPatch, errors: dict[str, float | None]) -> list[tuple[str, Any]]:
    """Let fits have errors by kind and size; return the list of them and their starts."""
    seen = []

    def held_out(request):
        settings = request.settings
        name = {
            "field": f"field {settings.plays}",
            "generalised_duhem": f"generalised_duhem {settings.cells}",
        }.get(settings.kind, settings.kind)
        name += " creeping" * settings.looks_for("activation")
        name += " accommodating" * settings.looks_for("accommodation")
        if settings.has("structure") and not settings.structure:
            name += " rigid"
        rms = errors.get(name)
        if rms is None:
            return None
        seen.append((name, request.start))
        judgement = Evaluation(
            errors=(),
            modelled_um=(),
            peak_percent=3.0 * rms,
            rms_percent=rms,
            own_peak_percent=0.0,
            classes=(StrokeError("full stroke", 3.0 * rms, rms, 1),),
        )
        return HeldOut(judgement, tuple(request.records), "test", f"end of {name}")

    monkeypatch.setattr(
        model_selection, "held_out_errors", lambda requests, run: run(held_out, requests)
    )
    monkeypatch.setattr(model_selection, "alike_loops", lambda records: iter(()))
    return seen


def chosen(records: list[Record], *texts: str) -> tuple[FitSettings, tuple[CandidateScore, ...]]:
    found = select(FitRequest(records, settings_from("auto", texts)))
    return found.settings, found.candidates


def test_the_kind_whose_small_model_does_well_is_tried_in_full(monkeypatch):
    seen = fake(monkeypatch, {**SMALL, "generalised_duhem 12": 0.7})
    found = select(FitRequest([HISTORY], settings_from("auto", [])))
    settings, held_out, errors = found.settings, found.held_out, found.candidates
    assert (settings.kind, settings.plays, settings.whole) == ("field", 32, True)
    assert held_out.judgement.rms_percent == 0.15
    assert [error.rms_percent for error in errors] == [0.3, 0.7, 0.15]
    # The larger one goes on from where the small one ended, and the fit to all data from there.
    assert [start for _, start in seen] == [None, None, "end of field 8"]
    assert held_out.end == "end of field 32"


def test_plays_that_creep_are_tried_in_full_if_rests_creep(monkeypatch):
    monkeypatch.setattr(model_selection, "creeps", lambda records: True)
    creeping = {"field 8 creeping": 0.2, "field 16 creeping": 0.08}
    seen = fake(monkeypatch, {**SMALL, "generalised_duhem 12": 9.0, **creeping})
    settings, _ = chosen([HISTORY])
    assert settings.activation
    assert [name for name, _ in seen][-1] == "field 16 creeping"


def test_plays_that_accommodate_are_tried_if_all_others_are_poor(monkeypatch):
    poor = {"field 8": 3.0, "generalised_duhem 12": 4.0}
    better = {"field 8 accommodating": 0.7, "field 32 accommodating": 0.1}
    fake(monkeypatch, poor | better)
    settings, _ = chosen([HISTORY])
    assert (settings.plays, settings.accommodation) == (32, True)


def test_more_operators_are_taken_only_where_they_are_worth_it(monkeypatch):
    fake(monkeypatch, {**SMALL, "generalised_duhem 12": 0.7, "field 32": 0.99 * 0.3})
    settings, _ = chosen([HISTORY])
    assert (settings.kind, settings.plays) == ("field", 8)


def test_a_kind_that_is_near_is_tried_in_full_as_well(monkeypatch):
    fake(monkeypatch, {**SMALL, "generalised_duhem 28": 0.12})
    settings, errors = chosen([HISTORY])
    assert settings.kind == "generalised_duhem"
    assert [error.rms_percent for error in errors] == [0.3, 0.5, 0.15, 0.12]


def test_a_kind_is_selected_on_small_motions_as_well(monkeypatch):
    """The rms error of a whole history is that of its large motions."""
    fake(monkeypatch, {**SMALL, "generalised_duhem 28": 0.3})
    judge = model_selection.held_out_errors

    def with_small_motions(requests, run):
        found = list(judge(requests, run))
        for request, each in zip(requests, found, strict=True):
            if each is None:
                continue
            small = 0.2 if request.settings.kind == "generalised_duhem" else 2.0
            errors = (*each.judgement.classes, StrokeError("tenth stroke", small, small, 9))
            object.__setattr__(each.judgement, "classes", errors)
        return found

    monkeypatch.setattr(model_selection, "held_out_errors", with_small_motions)
    assert chosen([HISTORY])[0].kind == "generalised_duhem"


@pytest.mark.parametrize("plain", [0.8, 5.0])
def test_a_plain_kind_is_tried_where_no_other_does_well(plain, monkeypatch):
    poor = {"field 8": 2.0, "generalised_duhem 12": 1.9, "field 32": 1.8}
    fake(monkeypatch, {**poor, "generalised_duhem 28": 1.7, "integrated": plain})
    settings, _ = chosen([HISTORY])
    assert settings.kind == ("integrated" if plain < 1.0 else "generalised_duhem")


@pytest.mark.parametrize(("plain", "alike", "kind"), [
    (0.14, False, "ppi"), (0.17, False, "field"), (0.25, True, "ppi"), (0.7, True, "field"),
])  # fmt: skip
def test_the_simplest_kind_wins_if_it_is_as_good(plain, alike, kind, monkeypatch):
    """Data of one amplitude or frequency do not show that more parts are worth it."""
    fake(monkeypatch, {**SMALL, "ppi": plain})
    monkeypatch.setattr(model_selection, "alike_loops", lambda records: iter(["alike"] * alike))
    assert chosen([HISTORY])[0].kind == kind


def test_a_structure_is_left_out_unless_it_is_worth_it(monkeypatch):
    fake(monkeypatch, {**SMALL, "field 8 rigid": 0.29, "field 32 rigid": 0.14})
    monkeypatch.setattr(model_selection, "alike_loops", lambda records: iter(["alike"]))
    settings, _ = chosen([HISTORY])
    assert (settings.plays, settings.structure, settings.modes) == (32, False, False)


def test_loops_have_candidates_of_their_own(monkeypatch):
    fake(monkeypatch, {"staged": 0.1, "integrated": None})
    settings, errors = chosen([LOOP])
    assert settings.kind == "staged"
    assert len(errors) == len(LOOPS) - 1 == 1


def test_without_anything_held_out_there_is_no_choice(monkeypatch):
    fake(monkeypatch, dict.fromkeys(("field 8", "generalised_duhem 12", "integrated")))
    with pytest.raises(DataError, match="--model"):
        chosen([HISTORY])


def test_candidates_look_for_the_parts_that_are_asked_for(monkeypatch):
    given = []

    def held_out_errors(requests, run):
        asked = [request.settings for request in requests]
        given.extend((each.kind, each.creep_stage, each.modes) for each in asked)
        return [None] * len(requests)

    monkeypatch.setattr(model_selection, "held_out_errors", held_out_errors)
    with pytest.raises(DataError, match="too few data"):
        chosen([HISTORY], "modes=false", "creep_stage=false")
    assert given == [
        ("ppi", True, True),
        ("field", False, False),
        ("field", False, False),
        ("generalised_duhem", False, False),
        ("integrated", True, True),
        ("field", False, False),
    ]


@pytest.mark.slow
def test_lag_of_a_table_is_found():
    stage = PpiModel(
        input_unit="V", direct=1.0, weights=(0.5, 0.3, 0.2), thresholds=(0.2, 0.5, 0.9)
    )
    time = np.arange(1500)
    command = 1.8 + 1.8 * np.sin(2.0 * np.pi * time / 200.0) * np.linspace(0.2, 1.0, 1500)
    late = np.roll(stage.forward(200.0).process(command), 3)

    def load(lag):
        return [History("stage", command, late, 200.0, ignore=10).without_lag(lag)]

    settings = FitSettings(kind="ppi", weights="free", offset=True)
    assert choose_lag(load, settings, map, ignore_progress) == 3


def test_creep_and_zero_of_each_history_are_taken_out():
    truth = PpiModel(direct=1.0, weights=(0.8, 0.4), thresholds=(0.5, 1.0))
    time = np.arange(2000)
    command = 2.0 * np.sin(2.0 * np.pi * time / 200.0) * np.linspace(0.3, 1.0, 2000)
    clean = truth.forward(200.0).process(command)
    data = [
        History(f"run {i}", command, clean + zero + creep * np.log1p(time / 20.0), 200.0, 10)
        for i, (zero, creep) in enumerate([(3.0, 0.2), (-5.0, 0.1)])
    ]
    choices = {"plays": 4, "weights": "free", "starts": 1}
    for creep, low, high in ((True, 0.0, 0.02), (False, 5.0, 100.0)):
        settings = FitSettings(kind="ppi", creep=creep, offset=True, **choices)
        found = fit_model(FitRequest(data, settings))
        assert low <= found.peak_percent <= high
