"""The data that a fit is made on."""

import pytest

from hilctl.base.errors import DataError
from hilctl.identify.fit_data import FitData


def test_no_loops_are_refused():
    """There is nothing to find a model from on an empty list."""
    with pytest.raises(DataError, match="empty"):
        FitData([], "A")
