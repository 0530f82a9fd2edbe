"""What is held out in turn, and when a refinement counts as better."""

from dataclasses import replace

import numpy as np
import pytest

from hilctl.base.errors import DataError
from hilctl.identify.evaluation import judgement_of
from hilctl.identify.fit_api import FitData
from hilctl.identify.model_selection import HeldOut
from hilctl.identify.refine.regularisation import (
    STRENGTHS,
    Regularisation,
    RegularisationSplit,
    SelectedRegularisation,
    parts_of,
)
from tests.unit.identify.refine.conftest import OLD, history


def held_out(factors):
    """Errors of so much of each run."""
    runs = tuple(history(OLD, i) for i in range(len(factors)))
    data = FitData(runs)
    modelled = np.concatenate([(1.0 + f) * run.displacement_um
                               for f, run in zip(factors, runs, strict=True)])  # fmt: skip
    return HeldOut(judgement_of(data, modelled), runs, "for a test")


@pytest.mark.parametrize(("before", "after", "better"), [
    ((0.02, 0.02), (0.01, 0.01), True),
    ((0.02, 0.02), (0.02, 0.02), False),
    ((0.10, 0.01), (0.03, 0.012), True),
    ((0.10, 0.01), (0.03, 0.016), False),
])  # fmt: skip
def test_better_in_the_mean_and_nowhere_much_worse(before, after, better):
    choice = SelectedRegularisation(0.1, 1.0, False, held_out(before), held_out(after))
    assert choice.better == better


@pytest.mark.parametrize(("factor", "even"), [(1.0, True), (1.1, True), (1.15, False), (0.1, True)])
def test_one_stretch_that_gets_worse_is_seen(factor, even):
    before, after = held_out((0.02, 0.02)), held_out((0.01, 0.01))
    modelled = after.judgement.modelled_um[1]
    measured = after.records[1].displacement_um
    last = -(modelled.size // 10)
    modelled[last:] = (1.0 + factor * 0.02) * measured[last:]
    choice = SelectedRegularisation(0.1, 1.0, False, before, after)
    assert choice.better
    assert choice.even == even


class Tried(Regularisation):
    """Ways whose errors on runs held out are told, by strength and anchor."""

    def __init__(self, errors):
        self.errors, self.kinds = errors, {}

    def _tried(self, strength, anchor, *, own):
        error = self.errors.get((strength, anchor), 0.02)
        kind = self.kinds.get(strength, SelectedRegularisation)
        choice = kind(strength, anchor, own, held_out((0.02, 0.02)), held_out((error, error)))
        return choice, (strength, anchor), 100.0 * error


class Uneven(SelectedRegularisation):
    """A way that makes a stretch worse."""

    @property
    def even(self):
        return False


@pytest.mark.parametrize(("error", "taken"), [(0.0149, 0.3), (0.0151, 0.1)])
def test_no_more_than_half_is_left_for_the_sake_of_a_stretch(error, taken):
    tried = Tried({(0.1, 1.0): 0.01, (0.3, 1.0): error})
    tried.kinds[0.1] = Uneven
    assert tried.best(lambda *_: None)[0].strength == taken


@pytest.mark.parametrize(
    ("errors", "taken"),
    [
        ({}, (0.1, 1.0)),
        ({(0.1, 10.0): 0.0101}, (0.1, 10.0)),
        ({(0.1, 10.0): 0.0101, (0.1, 100.0): 0.0101}, (0.1, 100.0)),
        ({(0.1, 10.0): 0.01, (0.1, 100.0): 0.0103}, (0.1, 10.0)),
        ({(0.1, 10.0): 0.0103, (0.1, 100.0): 0.02}, (0.1, 1.0)),
        ({(0.1, 1.0): 0.02, (0.3, 10.0): 0.01}, (STRENGTHS[0], 1.0)),
    ],
)
def test_the_old_model_is_held_to_where_that_costs_nothing(errors, taken):
    tried = Tried({(0.1, 1.0): 0.01} | errors)
    choice, whole = tried.best(lambda *_: None)
    assert whole == taken == (choice.strength, choice.anchor)


def test_each_of_several_runs_is_judged_by_what_the_others_say():
    runs = [history(OLD, i) for i in range(3)]
    parts, splits = parts_of(runs, ())
    assert parts == tuple(runs)
    assert splits == (
        RegularisationSplit((1, 2), (0,)),
        RegularisationSplit((0, 2), (1,)),
        RegularisationSplit((0, 1), (2,)),
    )


def test_others_to_validate_with_are_never_fitted():
    runs = [history(OLD, i) for i in range(3)]
    _, splits = parts_of(runs[:2], runs[2:])
    assert splits == (RegularisationSplit((0, 1), (2,)),)


def test_a_run_too_short_to_be_cut_is_refused():
    run = history(OLD, 1)
    short = replace(run, command=run.command[:20], displacement_um=run.displacement_um[:20])
    with pytest.raises(DataError, match="more recordings"):
        parts_of([short], ())
