"""Rule that accepts a refined model: the worst class improves, and no run loses much."""

import math

import pytest

from hilctl.base.errors import InputError
from hilctl.lab.identify.refine.acceptance import AcceptanceRule, ErrorChange

RULE = AcceptanceRule(range_um=80.0, tolerance_percent=0.2)


def runs(*errors):
    """Return runs of the strokes 80, 40, 20 and 8 um with errors before and after."""
    strokes = (80.0, 40.0, 20.0, 8.0)
    return [
        ErrorChange(f"run {i}", strokes[i % 4], was, now, 1.0, 1.0)
        for i, (was, now) in enumerate(errors)
    ]


@pytest.mark.parametrize(("errors", "refused"), [
    (((1.0, 0.5), (1.0, 0.5)), 0),
    (((1.0, 0.95), (1.0, 0.92)), 1),  # no class gains a tenth
    (((1.0, 1.05), (3.0, 1.0), (2.0, 1.0), (4.0, 2.0)), 0),  # a tenth of its error
    (((0.1, 0.29), (3.0, 1.0), (2.0, 1.0), (4.0, 2.0)), 0),  # the tolerance
    (((0.1, 0.31), (3.0, 1.0), (2.0, 1.0), (4.0, 2.0)), 1),
    (((3.0, 3.29), (3.0, 1.0), (2.0, 1.0), (4.0, 2.0)), 0),
    (((3.0, 3.31), (3.0, 1.0), (2.0, 1.0), (4.0, 2.0)), 1),
    (((1.0, 0.5), (1.0, 0.5), (1.0, 0.5), (4.0, 4.01)), 1),  # the worst class does not improve
    (((1.0, 1.0), (1.0, 1.0)), 2),
    (((1.0, 1.3), (1.0, 1.3)), 3),
    (((0.0, 0.0), (0.0, 0.0)), 1),
])  # fmt: skip
def test_a_model_may_trade_a_little_for_its_worst_class(errors, refused):
    assert len(RULE.reasons(runs(*errors))) == refused


@pytest.mark.parametrize(("peaks", "refused"), [((1.0, 1.6), 0), ((1.42, 2.11), 1)])
def test_a_peak_that_rises_refuses_a_smaller_rms_error(peaks, refused):
    assert len(RULE.reasons([ErrorChange("a", 80.0, 1.0, 0.5, *peaks)])) == refused


def test_one_run_a_little_worse_does_not_veto_fourteen_that_are_better():
    errors = [(1.0, 0.5)] * 14 + [(0.05, 0.1)]
    assert not RULE.reasons(runs(*errors))


def test_suggested_tolerance_accepts_the_model():
    traded = runs((0.1, 0.513), (0.2, 0.6), (2.0, 1.0), (4.0, 2.0))
    reasons = RULE.reasons(traded)
    assert "run 0" in reasons[0]
    assert "0.513 %" in reasons[0]
    suggested = float(reasons[-1].split()[-1])
    assert suggested == pytest.approx(0.42)
    assert not AcceptanceRule(80.0, suggested).reasons(traded)


@pytest.mark.parametrize(("stroke_um", "name"), [
    (120.0, "full stroke"), (57.0, "full stroke"), (56.0, "half stroke"), (28.0, "quarter stroke"),
    (12.0, "tenth stroke"), (0.1, "tenth stroke"),
])  # fmt: skip
def test_class_of_a_reference(stroke_um, name):
    run = ErrorChange("a", stroke_um, 1.0, 1.0, 1.0, 1.0)
    assert [each.label for each in RULE.classes([run])] == [name]


def test_error_of_a_class_is_the_root_mean_square_of_its_runs():
    found_runs = [("a", 80.0, 3.0, 1.0, 5.0, 6.0), ("b", 70.0, 4.0, 1.0, 7.0, 2.0)]
    (found,) = RULE.classes([ErrorChange(*run) for run in found_runs])
    assert (found.before, found.after) == (pytest.approx(math.sqrt(12.5)), pytest.approx(1.0))
    assert (found.peak_before, found.peak_after) == (7.0, 6.0)
    assert found.peak_to_peak_um == 80.0


@pytest.mark.parametrize("tolerance", [-0.1, 100.1, math.nan])
def test_a_tolerance_out_of_range_is_refused(tolerance):
    with pytest.raises(InputError, match="tolerance_percent"):
        AcceptanceRule(80.0, tolerance)
