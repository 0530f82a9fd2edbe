"""A stretch of a run: what would be seen of the whole between two times, in less memory."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from hilctl.analysis.report import summarize
from hilctl.base.errors import DataError
from hilctl.base.segments import Segment
from hilctl.recording.read_budget import ReadBudget
from hilctl.recording.reader import read
from hilctl.recording.time_range import TimeRange

GOLDEN = Path(__file__).parents[3] / "recordings" / "golden" / "terfenol_compensated.mcap"


@pytest.mark.parametrize(
    ("from_s", "to_s", "first", "last"),
    [
        (None, None, 0, 6149),
        (0.01, None, 500, 6149),
        (None, 0.01, 0, 499),
        (0.00101, 0.00201, 51, 100),
        (0.03, 99.0, 1500, 6149),
        (-5.0, 1 / 50_000, 0, 0),
        (-1e308, 1e308, 0, 6149),
    ],
)
def test_it_is_cut_by_the_time_of_the_samples(from_s, to_s, first, last):
    """From the first time on, before the other; ticks by their first sample."""
    part = read(GOLDEN, TimeRange(from_s, to_s))
    assert (part.samples.index[0], part.samples.index[-1]) == (first, last)
    assert {values.size for values in part.samples.columns().values()} <= {0, last + 1 - first}
    ticks = part.ticks.first_sample
    assert ticks.size == part.ticks.late_ns.size
    assert ((ticks >= first) & (ticks <= last)).all()
    whole = read(GOLDEN).samples.part(first, last + 1)
    assert part.samples.displacement_um.tobytes() == whole.displacement_um.tobytes()


@pytest.mark.parametrize(
    ("from_s", "to_s"), [(0.02, 0.01), (5.0, None), (None, -1e308), (1e308, None), (np.nan, None)]
)
def test_no_sample_between_the_times_is_an_error(from_s, to_s):
    with pytest.raises(DataError, match=r"terfenol_compensated.mcap: .*(holds no sample|finite)"):
        read(GOLDEN, TimeRange(from_s, to_s))


def test_blocks_elsewhere_are_not_kept(monkeypatch):
    """The budget counts what stays in memory."""
    kept = []

    class Counting(ReadBudget):
        def keep(self, size):
            kept.append(size)
            super().keep(size)

    monkeypatch.setattr("hilctl.recording.recovery_scan.ReadBudget", Counting)
    read(GOLDEN)
    whole = sum(kept)
    del kept[:]
    read(GOLDEN, TimeRange(0.05, 0.06))
    assert sum(kept) < whole / 4


def test_figures_of_a_stretch_are_those_of_its_steady_cycles():
    """Judged as if the run had been cut there; its counters are of the whole, and left out."""
    whole, part = read(GOLDEN), read(GOLDEN, TimeRange(0.05, 0.0951))
    (one,) = part.segments
    assert (one.start, one.steady_start, one.steady_stop, one.stop) == (0, 2500, 4755, 4755)
    report = summarize(part)
    by_hand = replace(whole, segments=(replace(whole.segments[0], steady_stop=4755),))
    assert report.peak_hysteresis_percent == summarize(by_hand).peak_hysteresis_percent
    assert report.complete
    assert (report.dropped, report.skipped_ticks) == (0, None)
    assert report.reason == summarize(whole).reason


def test_segments_are_cut_and_keep_their_phase():
    segments = tuple(
        Segment(str(k), start, start + 1000, start + 100, start + 900, 100.0)
        for k, start in enumerate(range(0, 4000, 1000))
    )
    recording = replace(read(GOLDEN), segments=segments)
    cut = TimeRange(0.0205, 0.041).cut(recording).segments  # samples 1025 to 2049
    assert [(s.start, s.steady_start, s.steady_stop, s.stop) for s in cut] == [
        (1000, 1100, 1900, 2000),
        (2000, 2050, 2050, 2050),
    ]


def test_gaps_count_within_it_only():
    recording = read(GOLDEN)
    gap = recording.samples.rows(
        (recording.samples.index < 1000) | (recording.samples.index > 1009)
    )
    recording = replace(recording, samples=gap)
    assert TimeRange(0.01, 0.03).cut(recording).dropped == 10
    assert TimeRange(0.03, 0.04).cut(recording).dropped == 0
    assert str(TimeRange(None, 0.5)) == "its start to 0.5 s"
