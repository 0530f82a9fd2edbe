"""The section ``limits``: for a current or for a voltage, and complete."""

import pytest
from pydantic import ValidationError

from hilctl.experiment.limits import Limits

STROKE = {"stroke_um": (-50.0, 50.0)}
CURRENT = {"peak_current_a": 7.0, "slew_a_per_s": 1e4}
VOLTAGE = {"drive_v": (-20.0, 120.0), "slew_v_per_s": 2e4}


def test_a_peak_current_counts_both_ways_and_a_drive_as_it_is():
    current, voltage = Limits(**STROKE, **CURRENT), Limits(**STROKE, **VOLTAGE)
    assert (current.unit, current.command_range, current.slew_per_s) == ("A", (-7.0, 7.0), 1e4)
    assert (voltage.unit, voltage.command_range, voltage.slew_per_s) == ("V", (-20.0, 120.0), 2e4)


@pytest.mark.parametrize("given", [{}, {"peak_current_a": 7.0}, {"slew_v_per_s": 2e4},
                                   {**CURRENT, "drive_v": (0.0, 1.0)},
                                   {**CURRENT, **VOLTAGE}])  # fmt: skip
def test_incomplete_and_mixed_limits_are_refused(given):
    """Half a limiter is none."""
    with pytest.raises(ValidationError, match="must have either peak_current_a and slew_a_per_s"):
        Limits(**STROKE, **given)
