"""The loops of a known model."""

from collections.abc import Callable

import pytest

from hilctl.lab.identify.data.records import SteadyLoop
from hilctl.lab.identify.fit_data import FitData
from hilctl.models.staged import FieldLag
from tests.staged import GRID, truth


@pytest.fixture
def data(loops_of: Callable[..., list[SteadyLoop]]) -> FitData:
    """Return what a fit knows of the loops of a lag before plays and deadbands."""
    loops = loops_of(truth(lag=FieldLag(tau_s=1e-4, growth_per_unit=0.3)), GRID[::3])
    return FitData(loops)
