"""What was found, in rows and lines."""

from types import SimpleNamespace

import pytest

from hilctl.identify.judge import LoopError
from hilctl.identify.summary import HEADINGS, error_rows, parameter_texts, summary


def found(held_out=None, lag_samples=0, starts=()):
    fit = SimpleNamespace(
        numbers=7, elapsed_s=1.234, peak_percent=2.5, rms_percent=0.75, own_peak_percent=4.0,
        starts=[SimpleNamespace(rms_percent=each) for each in starts],
        parameters={"a_0": 4.0, "tau_s": 1e-4}, standard_errors={"tau_s": 2e-6},
    )  # fmt: skip
    return SimpleNamespace(fit=fit, held_out=held_out, lag_samples=lag_samples)


@pytest.mark.parametrize(("area", "text"), [(None, "-"), (1.5, "+1.50"), (-0.25, "-0.25")])
def test_the_area_s_error_has_a_sign_and_a_history_has_none(area, text):
    (row,) = error_rows([LoopError("sine", 1.25, 0.5, area, 80.0)])
    assert row == ("sine", "80", "1.25", "0.5", text)
    assert len(row) == len(HEADINGS)


def test_a_parameter_stands_with_its_standard_error_where_there_is_one():
    assert parameter_texts(found().fit) == [("a_0", "4"), ("tau_s", "0.0001 ± 2e-06")]


def test_starts_that_ended_apart_are_shown_by_their_spread():
    assert (
        summary(found(starts=(0.75, 0.8)))[0] == "2 starts ended at rms 0.750 to 0.800 %, in 1.23 s"
    )
    assert summary(found())[0] == "7 numbers found, in 1.23 s"


def test_data_not_fitted_and_a_lag_have_lines_of_their_own():
    held_out = SimpleNamespace(peak_percent=3.0, rms_percent=1.0)
    lines = summary(found(held_out, lag_samples=2))
    assert len(lines) == len(summary(found())) + 2
    assert lines[-2].startswith("not fitted: peak error 3.00 %")
    assert lines[-1] == "displacements taken 2 samples later than the commands"
