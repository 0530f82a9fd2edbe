"""What is left out of which fit, and what never is."""

import numpy as np
import pytest

from hilctl.identify.cross_validation import folds_of
from hilctl.identify.data.records import History
from hilctl.models.plays import PpiModel

MODEL = PpiModel(direct=4.0, weights=(1.0,), thresholds=(0.5,))
GRID = [(a, f) for a in (2.0, 4.0, 6.0) for f in (10.0, 50.0, 100.0)]


@pytest.fixture
def grid(loop_of):
    """Nine loops."""
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


def test_a_history_that_rests_at_its_end_is_fitted_as_a_whole():
    """Errors in percent of the little that a rest moves by would say nothing."""
    envelope = np.where(np.arange(1000) < 650, 1.0, 0.02)
    assert folds_of([history(envelope)]) == []
