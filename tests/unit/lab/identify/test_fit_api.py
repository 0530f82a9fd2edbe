"""Data and jobs of a fit."""

import pytest

from hilctl.lab.identify.fit_api import LEAST_SLOPE, FitJob
from hilctl.lab.identify.settings import FitSettings
from hilctl.models.plays import PpiModel


def test_the_least_slope_is_a_part_of_the_data_s_gain(data_of):
    """Um per command unit: loops of 6 A and a straight line of 4 um/A."""
    data = data_of(PpiModel(direct=4.0, weights=(), thresholds=()))
    job = FitJob(data, FitSettings(kind="ppi"))
    assert data.gain == pytest.approx(4.0, rel=1e-3)
    assert job.least == pytest.approx(4.0 * LEAST_SLOPE, rel=1e-3)
    assert list(job.run(abs, [-1, 2])) == [1, 2]
