"""What reference runs say of drift."""

from hilctl.series.drift import drift_of
from hilctl.series.run_figures import RunFigures


def reference(peak_to_peak_um, mean_um):
    return RunFigures(
        peak_to_peak_um=peak_to_peak_um, mean_um=mean_um, peak_hysteresis_percent=10.0
    )


def test_the_largest_change_counts_with_its_sign():
    found = drift_of([reference(50.0, 1.0), reference(49.0, 1.2), reference(50.5, 0.5)])
    assert (found.runs, found.peak_to_peak_percent, found.mean_um) == (3, -2.0, -0.5)
    assert str(found) == (
        "drift over 3 reference runs: -2 % in peak-to-peak, -0.5 µm in mean, "
        "+0 points of hysteresis"
    )


def test_one_run_says_nothing():
    assert drift_of([reference(50.0, 1.0)]) is None
    assert "nothing to compare" not in str(drift_of([reference(50.0, 1.0)] * 2))
    assert drift_of([reference(None, None)] * 2).peak_to_peak_percent is None
