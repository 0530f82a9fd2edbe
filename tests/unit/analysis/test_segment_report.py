"""Figures of a segment: the same however its samples come."""

from dataclasses import asdict, replace

import numpy as np
import pytest

from hilctl.analysis.segment_report import SegmentReportBuilder
from hilctl.base.samples import Flag
from hilctl.base.segments import Segment

RATE_HZ = 50_000.0
N = 20_000


@pytest.fixture
def recording(make_recording):
    """A compensated sine with noise, a gap, and readings that are doubtful or NaN."""
    index = np.arange(N)
    index[N // 2 :] += 137
    rng = np.random.default_rng(4)
    reference = 40.0 * np.sin(2.0 * np.pi * index / 500)
    displacement = reference + 0.3 * np.cos(2.0 * np.pi * index / 500) + rng.normal(0, 0.01, N)
    displacement[7_000:7_003] = np.nan
    flags = np.zeros(N, dtype=np.uint32)
    flags[12_000:12_040] = Flag.SENSOR_INVALID
    return make_recording(displacement, reference_um=reference, index=index, flags=flags)


def figures(recording, segment, window, bounds):
    gathering = SegmentReportBuilder(recording, segment, window)
    for part in np.split(np.arange(N), bounds):
        if part.size:
            gathering.add(recording.samples.rows(slice(part[0], part[-1] + 1)))
    found = asdict(gathering.report())
    assert found.pop("label") == "sine"
    return {name: value for name, value in found.items() if value is not None}


@pytest.mark.parametrize("compensated", [True, False])
@pytest.mark.parametrize("period", [500.0, 1000.0 / 3.0, 0.0])
@pytest.mark.parametrize("bounds", [[1], [9_997, 9_998, 10_001], range(0, N, 617), [0, 5, 5, 9]])
def test_pieces_give_what_the_whole_gives(recording, period, bounds, compensated):
    segment = Segment("sine", 0, N, 500, N - 500, period)
    recording = replace(recording, compensated=compensated)
    window = (1000, N - 500, 37 if period else 0)
    whole = figures(recording, segment, window, [])
    parts = figures(recording, segment, window, bounds)
    assert parts == pytest.approx(whole, rel=1e-9)
    assert whole["sensor_noise_um"] == pytest.approx(0.01, rel=0.03)
    assert parts["steady_samples"] == whole["steady_samples"] < N - 1500


def test_a_segment_that_was_not_reached_has_none(recording):
    segment = Segment("sine", 2 * N, 3 * N, 2 * N, 3 * N, 500.0)
    found = figures(recording, segment, (2 * N, 3 * N, 40), [])
    assert (found["samples"], found["steady_samples"]) == (0, 0)
    assert found.keys() == {"start_s", "frequency_hz", "samples", "steady_cycles", "steady_samples"}
