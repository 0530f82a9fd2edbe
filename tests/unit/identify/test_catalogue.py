"""Every kind of model has one way to be found, and that way gives that kind."""

import pytest

from hilctl.base.errors import InputError
from hilctl.identify.catalogue import CATALOGUE, entry
from hilctl.identify.job import FitJob
from hilctl.identify.settings import FitSettings
from hilctl.models.plays import PpiModel

QUICK = ["straight", "duhem", "preisach", "krasnoselskii_pokrovskii", "ppi"]
TRUTH = PpiModel(direct=4.0, weights=(1.0, 2.0), thresholds=(0.5, 1.5))


@pytest.mark.parametrize("kind", [kind for kind in CATALOGUE if kind in QUICK])
def test_what_is_found_is_of_the_kind_that_was_asked_for(data_of, kind):
    """A straight line is a PPI without plays."""
    name, known = entry(kind)
    found = known.fit(FitJob(data_of(TRUTH), FitSettings(kind=name)))
    assert found.model.kind == ("ppi" if kind == "straight" else kind)
    assert found.numbers >= 1


def test_a_slip_of_the_finger_is_answered_with_the_nearest_kind():
    with pytest.raises(InputError, match=r"unknown kind of model 'duhm'.*duhem"):
        entry("duhm")


def test_no_two_kinds_have_one_title():
    assert len({each.title for each in CATALOGUE.values()}) == len(CATALOGUE)
