"""Refined models: better on what they have not seen, or not written."""

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from hilctl import api
from hilctl.base.errors import DataError, InputError
from hilctl.lab.identify.evaluation import judgement_of
from hilctl.lab.identify.fit_data import FitData
from hilctl.lab.identify.model_page import refinement_page
from hilctl.lab.identify.model_selection import HeldOut
from hilctl.lab.identify.refine import refinement
from hilctl.lab.identify.refine.acceptance import AcceptanceRule
from hilctl.lab.identify.summary import (
    class_table,
    refinement_table,
    worse_lines,
)
from hilctl.models.model_file import load_model
from hilctl.recording.reader import read
from tests.published import piezo_ppi
from tests.unit.lab.identify.refine.conftest import (
    OLD,
    RATE_HZ,
    actuator,
    command,
    five_runs,
    history,
)

ROOT = Path(__file__).parents[5]
GOLDEN = ROOT / "recordings" / "golden"
COMPENSATED = GOLDEN / "terfenol_compensated.mcap"
RULE = AcceptanceRule(range_um=100.0)
OMEGA = ROOT / "configs" / "models" / "terfenol_omega.yaml"


def missed_percent(model, truth, v):
    """Rms error of a model on a command, of the peak-to-peak displacement."""
    wanted = truth.forward(RATE_HZ).process(v)
    error = model.forward(RATE_HZ).process(v) - wanted
    return 100.0 * float(np.sqrt(np.mean(error**2)) / np.ptp(wanted))


@pytest.fixture(scope="module")
def found():
    """Return what five runs make of the old model."""
    return refinement.refine_runs(OLD, five_runs(), source="old.yaml")


@pytest.mark.slow
@pytest.mark.parametrize("amplitude", [5.0, 3.0, 1.5])
def test_error_on_unseen_references_is_far_less_than_half(old, found, amplitude):
    v = command(77, amplitude)
    assert found.better
    assert missed_percent(found.model, actuator(), v) < 0.3 * missed_percent(old, actuator(), v)


@pytest.mark.slow
def test_small_runs_do_not_spoil_the_large_loop(old):
    small = [history(OLD, i, amplitude=0.7, noise_um=0.1) for i in range(4)]
    gain = [replace(run, displacement_um=0.97 * run.displacement_um) for run in small]
    found = refinement.refine_runs(old, gain)
    large = command(77, 6.5)
    assert missed_percent(found.model, OLD, large) < 0.5


@pytest.mark.slow
@pytest.mark.parametrize("drift_um", [0.0, 1.0])
def test_creep_of_single_runs_is_not_learned_as_hysteresis(old, drift_um):
    runs = [
        history(actuator(), i, drift_um=drift_um * (i - 2), amplitude=a)
        for i, a in enumerate((6.5, 6.5, 4.0, 2.0, 5.0))
    ]
    found = refinement.refine_runs(old, runs)
    v = command(77, 5.0)
    assert found.choice.own == (drift_um > 0.0)
    assert missed_percent(found.model, actuator(), v) < 0.4 * missed_percent(old, actuator(), v)


@pytest.mark.slow
def test_a_model_that_was_right_stays_as_it_is(old):
    found = refinement.refine_runs(old, [history(OLD, i, noise_um=0.05) for i in range(4)])
    assert not found.better
    assert str(found).startswith("no better")
    assert "noise" in found.reasons[0]


@pytest.mark.slow
def test_refining_what_was_refined_goes_on_from_it(old, runs):
    first = refinement.refine_runs(old, runs[:3]).model
    again = refinement.refine_runs(first, [history(actuator(offset_um=1.0), i, amplitude=3.0)
                                for i in range(20, 24)])  # fmt: skip
    assert again.better
    assert isinstance(again.model.base, type(old))
    v = command(77, 5.0)
    shifted = actuator(offset_um=1.0)
    assert missed_percent(again.model, shifted, v) < 0.5 * missed_percent(old, shifted, v)


@pytest.mark.slow
def test_one_run_is_judged_by_its_end(old):
    found = refinement.refine_runs(old, [history(actuator(), 1, seconds=2.0)])
    assert found.better
    assert len(found.choice.after.records) == 1
    assert found.choice.after.records[0].ignore > 10_000


@pytest.mark.slow
def test_provenance_says_what_it_was_refined_on(found):
    found = found.model.provenance
    assert found.source == ("old.yaml", "run 0", "run 1", "run 2", "run 3", "run 4")
    assert "5 runs" in found.method
    assert {"held_out_peak", "held_out_rms"} <= found.errors_percent.keys()
    assert "full stroke" in found.errors_by_stroke
    assert found.identified_range is not None


def test_swapped_wires_are_refused(old, runs):
    turned = [replace(run, displacement_um=-run.displacement_um) for run in runs]
    with pytest.raises(InputError, match="swap the wires"):
        refinement.refine_runs(old, turned)


def test_runs_that_get_worse_are_named():
    before, after = held_out((0.03, 0.01)), held_out((0.01, 0.011))
    choice = refinement.SelectedRegularisation(0.1, 1.0, False, before, after, RULE)
    found = refinement.Refinement(actuator(), choice, 1.0, ())
    assert [run.label for run in found.worse] == ["run 1"]
    assert [each["label"] for each in found.to_mapping()["worse"]] == ["run 1"]
    assert "run 1" in worse_lines(found)[0]


@pytest.mark.parametrize(("after", "fitted_ratio", "remedy"), [
    (0.004, 0.4, ""),
    (0.008, 0.4, "add runs"),
    (0.008, 0.7, "new model"),
])  # fmt: skip
def test_what_limits_a_small_gain_is_named(after, fitted_ratio, remedy):
    before, now = held_out((0.01, 0.01)), held_out((after, after))
    choice = refinement.SelectedRegularisation(0.1, 1.0, False, before, now, RULE)
    found = refinement.Refinement(actuator(), choice, fitted_ratio, ())
    assert (found.limit == "") == (remedy == "")
    assert remedy in found.limit
    assert str(found).endswith(found.limit)
    assert found.to_mapping()["limit"] == found.limit


@pytest.mark.slow
def test_fitted_runs_gain_at_least_as_much_as_held_out_ones(found):
    assert found.fitted_ratio < 1.05 * found.choice.ratio < 0.5


def test_a_file_that_exists_is_refused_before_anything_is_read(tmp_path):
    output = tmp_path / "better.yaml"
    output.write_text("mine")
    with pytest.raises(InputError, match=r"better\.yaml"):
        api.refine(tmp_path / "none.yaml", [], output)
    assert output.read_text() == "mine"


def test_a_run_from_rest_is_what_was_put_out_and_what_came():
    (run,), recording = refinement.load_runs([COMPENSATED], load_model(OMEGA)), read(COMPENSATED)
    assert run.ignore == 0
    np.testing.assert_array_equal(run.command, recording.samples.command[: run.command.size])


def test_a_run_that_goes_on_has_the_one_before_ahead_of_it():
    first = read(COMPENSATED)
    later = replace(first, run={**first.run, "run_id": "b", "initial_state_run_id": "a"})
    run = refinement._history(later, {"a": first, "b": later})
    still = round(refinement.STILL_S * first.sample_rate_hz)
    assert run.ignore == first.samples.index.size + still
    np.testing.assert_array_equal(run.command[: first.samples.index.size], first.samples.command)
    assert (run.command[run.ignore - still : run.ignore] == first.samples.command[-1]).all()


def test_a_run_that_goes_on_from_one_that_is_not_given_is_refused():
    first = read(COMPENSATED)
    later = replace(first, run={**first.run, "initial_state_run_id": "a"})
    with pytest.raises(DataError, match="that recording"):
        refinement._history(later, {})


def test_what_can_not_be_used_is_said(tmp_path):
    copy = Path(shutil.copy(COMPENSATED, tmp_path / "run.mcap"))
    with pytest.raises(InputError, match="named twice"):
        refinement.load_runs([copy, copy], load_model(OMEGA))
    with pytest.raises(InputError, match="no recordings"):
        refinement.load_runs([], load_model(OMEGA))
    with pytest.raises(DataError, match=r"in A.* V"):
        refinement.load_runs([copy], piezo_ppi())


@pytest.mark.slow
@pytest.mark.usefixtures("undrawn")
def test_page_has_verdict_table_figures_and_model(old, runs):
    found = refinement.refine_runs(old, runs[:3], source="a<b>.yaml")
    headings, rows = refinement_table(found)
    assert [row[0] for row in rows] == ["run 0", "run 1", "run 2"]
    assert all(len(row) == len(headings) for row in rows)
    headings, classes = class_table(found)
    assert all(len(row) == len(headings) for row in classes)
    page = refinement_page(found)
    assert "a&lt;b&gt;.yaml" in page
    assert "<b>" not in page.replace("<body>", "")
    assert page.count("<svg") == 2 * len(rows)
    assert "kind: refined" in page


def held_out(factors):
    runs = tuple(history(OLD, i) for i in range(len(factors)))
    data = FitData(runs)
    modelled = np.concatenate([(1.0 + f) * run.displacement_um
                               for f, run in zip(factors, runs, strict=True)])  # fmt: skip
    return HeldOut(judgement_of(data, modelled), runs, "for a test")


@pytest.mark.parametrize(("factor", "even"), [(1.0, True), (1.1, True), (1.15, False), (0.1, True)])
def test_one_stretch_that_gets_worse_is_seen(factor, even):
    before, after = held_out((0.02, 0.02)), held_out((0.01, 0.01))
    modelled = after.judgement.modelled_um[1]
    measured = after.records[1].displacement_um
    last = -(modelled.size // 10)
    modelled[last:] = (1.0 + factor * 0.02) * measured[last:]
    choice = refinement.SelectedRegularisation(0.1, 1.0, False, before, after, RULE)
    assert choice.better
    assert choice.even == even


class Tried(refinement.Regularisation):
    """Ways whose errors on runs held out are told, by strength and anchor."""

    def __init__(self, errors):
        self.errors, self.kinds = errors, {}

    def _tried(self, strength, anchor, *, own):
        error = self.errors.get((strength, anchor), 0.02)
        kind = self.kinds.get(strength, refinement.SelectedRegularisation)
        before, after = held_out((0.02, 0.02)), held_out((error, error))
        choice = kind(strength, anchor, own, before, after, RULE)
        return choice, (strength, anchor), 100.0 * error


class Uneven(refinement.SelectedRegularisation):
    """A way that makes a stretch worse."""

    @property
    def even(self):
        return False


@pytest.mark.parametrize(("error", "taken"), [(0.0149, 0.3), (0.0151, 0.1)])
def test_no_more_than_half_is_left_for_the_sake_of_a_stretch(error, taken):
    tried = Tried({(0.1, 1.0): 0.01, (0.3, 1.0): error})
    tried.kinds[0.1] = Uneven
    assert tried.best(lambda *_: None)[0].strength == taken


@pytest.mark.parametrize(("errors", "taken"), [
    ({}, (0.1, 1.0)),
    ({(0.1, 10.0): 0.0101}, (0.1, 10.0)),
    ({(0.1, 10.0): 0.0101, (0.1, 100.0): 0.0101}, (0.1, 100.0)),
    ({(0.1, 10.0): 0.01, (0.1, 100.0): 0.0103}, (0.1, 10.0)),
    ({(0.1, 10.0): 0.0103, (0.1, 100.0): 0.02}, (0.1, 1.0)),
    ({(0.1, 1.0): 0.02, (0.3, 10.0): 0.01}, (0.3, 10.0)),
])  # fmt: skip
def test_the_old_model_is_held_to_where_that_costs_nothing(errors, taken):
    tried = Tried({(0.1, 1.0): 0.01} | errors)
    choice, whole = tried.best(lambda *_: None)
    assert whole == taken == (choice.strength, choice.anchor)


def test_each_of_several_runs_is_judged_by_what_the_others_say():
    runs = [history(OLD, i) for i in range(3)]
    parts, splits = refinement.parts_of(runs, ())
    assert parts == tuple(runs)
    assert splits == (
        refinement.RegularisationSplit((1, 2), (0,)),
        refinement.RegularisationSplit((0, 2), (1,)),
        refinement.RegularisationSplit((0, 1), (2,)),
    )


def test_others_to_validate_with_are_never_fitted():
    runs = [history(OLD, i) for i in range(3)]
    _, splits = refinement.parts_of(runs[:2], runs[2:])
    assert splits == (refinement.RegularisationSplit((0, 1), (2,)),)


def test_a_run_too_short_to_be_cut_is_refused():
    run = history(OLD, 1)
    short = replace(run, command=run.command[:20], displacement_um=run.displacement_um[:20])
    with pytest.raises(DataError, match="more recordings"):
        refinement.parts_of([short], ())
