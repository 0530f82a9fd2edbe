"""The straight line in the inverse's place: through the same ends, on either wing."""

from types import SimpleNamespace

import numpy as np
import pytest

from hilctl.experiment.linear_bypass import LineEnds, fade_refusal
from hilctl.loop.tuning import LinearBypass

REFERENCE = 10.0 + 5.0 * np.sin(np.arange(1000) / 50.0)


@pytest.mark.parametrize("slope", [0.2, -0.2])
@pytest.mark.parametrize("cut", [1, 77, 1000])
def test_line_leads_from_the_lowest_to_the_highest_command(slope, cut):
    """Whatever the lag between the two, and however they come."""
    command = 3.0 + slope * (10.0 + 5.0 * np.sin(np.arange(1000) / 50.0 + 0.3))
    ends = LineEnds()
    for start in range(0, 1000, cut):
        ends.add(REFERENCE[start : start + cut], command[start : start + cut])
    line = ends.line()
    reached = line.slope * REFERENCE + line.at_zero
    assert (reached.min(), reached.max()) == pytest.approx((command.min(), command.max()))
    assert line.slope == pytest.approx(slope, rel=1e-3)


def test_what_stands_still_or_is_no_number_has_no_line():
    for reference, command in (
        (np.full(10, 3.0), np.ones(10)),
        (REFERENCE, np.full(1000, np.inf)),
        (REFERENCE, np.where(REFERENCE > 14.0, np.nan, REFERENCE)),
    ):
        ends = LineEnds()
        ends.add(reference, command)
        assert ends.line() is None


def test_what_can_not_go_out_is_said():
    """An interlock on the tracking error would end the run; the way back in is never barred."""

    def refused(line=LinearBypass(), wanted="out", model=1, tracking_error_um=None):  # noqa: B008
        limits = SimpleNamespace(tracking_error_um=tracking_error_um)
        loaded = SimpleNamespace(model=model, config=SimpleNamespace(limits=limits))
        return fade_refusal(loaded, line, wanted)

    assert refused() == ""
    assert "no compensator" in refused(model=None)
    assert "stands still" in refused(line=None)
    assert "limits.tracking_error_um ends a run" in refused(tracking_error_um=5.0)
    assert refused(wanted="in", tracking_error_um=5.0) == ""
