"""Metrics of a segment in one pass, of its average cycle or of single samples."""

import numpy as np
import pytest

from hilctl.base.segments import Segment
from hilctl.signals.segment_metrics import SegmentMetrics

INDEX = np.arange(4000)
PHASE = 2.0 * np.pi * INDEX / 500.0
REFERENCE, LAG_UM = 10.0 * np.sin(PHASE), 0.5 * np.cos(PHASE)


@pytest.mark.parametrize("averaged", [True, False])
@pytest.mark.parametrize("compensated", [True, False])
def test_metrics_that_are_available(averaged, compensated):
    segment = Segment("sine", 0, 4000, 0, 4000, 500.0 if averaged else 0.0)
    metrics = SegmentMetrics(segment, averaged=averaged, compensated=compensated)
    assert metrics.metrics() == metrics.raw() == {}
    for part in np.array_split(INDEX, 7):
        metrics.add(part, np.array((REFERENCE[part], REFERENCE[part] + LAG_UM[part])))
    metrics.add(INDEX[:1], np.array(([1.0], [np.nan])))
    found = metrics.metrics(noise_um=0.01)
    assert found["peak_to_peak_um"] == pytest.approx(20.0, rel=2e-3)
    errors = {name for name in found if "error" in name}
    assert len(errors) == (4 if compensated else 0)
    if compensated:
        assert found["peak_error_percent"] == pytest.approx(2.5, rel=1e-3)
        assert found["rms_error_raw_percent"] == pytest.approx(2.5 / np.sqrt(2.0), rel=1e-3)
    of_loop = {"peak_hysteresis_percent", "loop_area", "noise_floor_percent"}
    assert found.keys() & of_loop == (of_loop if averaged else set())
    if averaged:
        assert found["peak_hysteresis_percent"] == pytest.approx(5.0, rel=1e-2)
