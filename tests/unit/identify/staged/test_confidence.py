"""Standard errors from how records disagree, on a fit that is linear in what is looked at."""

import numpy as np
import pytest

from hilctl.identify.staged.confidence import at_bound, standard_errors
from hilctl.identify.staged.fit_data import Linear
from hilctl.identify.staged.objective import DYNAMIC, Layers, Point
from hilctl.identify.staged.sensitivity import SPACING
from hilctl.identify.staged.staged_search import StagedEnd

LAYERS = Layers(plays=1, deadbands=0, lag=False, structure=False, delay=False)
SIZE, RECORDS, EACH = DYNAMIC + 2 + 3, 40, 30
POINT = Point(np.zeros(4), Linear(), 1.0, np.ones(1), (1.0, 1.0), np.zeros(0), np.zeros(0), 0.0)
PLACES = tuple(slice(EACH * i, EACH * (i + 1)) for i in range(RECORDS))


def ended(noise_um, free, seed=1, bound=()):
    """Where a search ended whose errors are each record's own deviation of a_0."""
    rng = np.random.default_rng(seed)
    slopes = np.zeros((RECORDS * EACH, SIZE))
    slopes[:, DYNAMIC] = np.tile(np.linspace(-1.0, 1.0, EACH), RECORDS)
    slopes[:, SPACING] = rng.normal(size=RECORDS * EACH)
    own = rng.normal(0.0, noise_um, RECORDS)
    errors = slopes[:, DYNAMIC] * np.repeat(own - own.mean(), EACH)
    mask = np.zeros(SIZE, dtype=bool)
    mask[list(free)] = True
    held = np.zeros(SIZE, dtype=bool)
    held[list(bound)] = True
    return StagedEnd(POINT, errors, slopes, mask, held, np.ones(RECORDS * EACH), ())


def test_records_that_differ_by_so_much_give_so_much_over_their_root():
    """Each record's own a_0 scatters by 0.5: the mean of 40 is known to 0.5 / sqrt(40)."""
    found = standard_errors(ended(0.5, [DYNAMIC]), LAYERS, PLACES, staged=True)
    assert found.keys() == {"a_0"}
    assert found["a_0"] == pytest.approx(0.5 / np.sqrt(RECORDS), rel=0.25)


def test_a_parameter_that_was_not_free_has_none():
    free = standard_errors(ended(0.5, [DYNAMIC, SPACING]), LAYERS, PLACES, staged=True)
    assert free.keys() == {"a_0", "alpha"}


def test_one_record_disagrees_with_nobody():
    assert standard_errors(ended(0.5, [DYNAMIC]), LAYERS, PLACES[:1], staged=True) == {}


def test_what_a_bound_holds_is_named():
    """Of what is in the model: it has no lag, so there is none to stand anywhere."""
    held = at_bound(ended(0.5, [], bound=[0, SPACING, DYNAMIC + 1]), LAYERS, staged=True)
    assert held == ("alpha", "a_1")
