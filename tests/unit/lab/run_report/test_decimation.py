"""Decimation of long recordings: spikes and evaluated samples are kept."""

from dataclasses import replace

import numpy as np
import pytest

from hilctl.analysis.report import summarize
from hilctl.analysis.steady_state import Overview, steady_part, steady_samples
from hilctl.base.segments import Segment
from hilctl.lab.pages.figure_layout import drawn
from hilctl.lab.run_report import decimation as module
from hilctl.lab.run_report import plots
from hilctl.lab.run_report.decimation import overview
from hilctl.lab.run_report.plots import hysteresis_loop
from hilctl.lab.run_report.run_page import page
from hilctl.recording.recording import Recording, Ticks

N = 60_000


@pytest.fixture
def recording(make_recording) -> Recording:
    """A compensated sine of two segments with one spike, a late tick, and a part without one."""
    index = np.arange(N)
    reference = 40.0 * np.sin(2.0 * np.pi * index / 500)
    rng = np.random.default_rng(4)
    displacement = reference + np.cos(2.0 * np.pi * index / 500) + rng.normal(0, 0.01, N)
    displacement[31_234] = 97.0
    displacement[100:300] = np.nan
    segments = [
        Segment("sine", 0, 30_000, 500, 29_500, 500.0),
        Segment("still", 30_000, N, 30_000, N - 700, 0.0),
    ]
    made = make_recording(displacement, reference_um=reference, segments=segments)
    made.ticks.late_ns[777] = 9_000_000
    return made


class Parts:
    """A recording in memory as pieces."""

    def __init__(self, whole: Recording, rows: int = 7_000) -> None:
        self._whole, self._rows = whole, rows
        self.walks = 0

    def __iter__(self):
        self.walks += 1
        whole = self._whole
        for at in range(0, N, self._rows):
            ticks = whole.ticks
            within = (ticks.first_sample >= at) & (ticks.first_sample < at + self._rows)
            columns = ("first_sample", "deadline_ns", "late_ns", "exchange_ns")
            yield replace(
                whole,
                samples=whole.samples.rows(slice(at, at + self._rows)),
                ticks=Ticks(*(getattr(ticks, name)[within] for name in columns)),
            )


@pytest.fixture
def small(monkeypatch):
    monkeypatch.setattr(module, "MOST_SAMPLES", 20_000)
    monkeypatch.setattr(module, "_STRETCHES", 1500)
    monkeypatch.setattr(module, "_LAST_SAMPLES", 8_000)


def test_short_recording_is_not_decimated(recording):
    found = overview(Parts(recording))[1]
    assert not isinstance(found, Overview)
    assert np.array_equal(found.samples.index, recording.samples.index)
    assert found.samples.command.tobytes() == recording.samples.command.tobytes()
    assert found.ticks.late_ns.tolist() == recording.ticks.late_ns.tolist()


def test_decimated_recording_keeps_spikes_and_evaluated_samples(small, recording):
    found = overview(Parts(recording))[1]
    assert isinstance(found, Overview)
    assert found.samples.index.size < 30_000
    assert np.all(np.diff(found.samples.index) > 0)
    assert 31_234 in found.samples.index
    known = np.isfinite(recording.samples.displacement_um)
    lowest_um = recording.samples.displacement_um[known].min()
    assert np.nanmin(found.samples.displacement_um) == lowest_um
    for segment in recording.segments:
        part, whole = steady_part(found, segment), steady_part(recording, segment)
        assert part.cycles == whole.cycles
        assert part.samples.index.size == 4_000
        assert part.samples.index[-1] == whole.samples.index[-1]
        if whole.cycle is not None:
            assert part.cycle.counts.tolist() == whole.cycle.counts.tolist()
            assert part.loop == pytest.approx(whole.loop, rel=1e-12)
        samples, cycles = steady_samples(found, segment)
        assert cycles == whole.cycles
        assert samples.index[-1] == whole.samples.index[-1]


def test_plots_of_a_decimated_recording_are_drawn(small, recording):
    found = overview(Parts(recording))[1]
    assert hysteresis_loop(found) is not None
    assert all(draw(found) is not None for draw in (plots.time_history, plots.error))
    (shown, *_), _ = (axes.lines for axes in drawn(plots.steady_cycles(found)).axes)
    index = np.round(shown.get_xdata() * found.sample_rate_hz)
    assert index.tolist() == list(range(29_500 - 1000, 29_500))


def test_page_of_a_decimated_recording_has_the_metrics_of_the_whole(small, recording, undrawn):
    pieces = Parts(recording)
    summary, shown = overview(pieces)
    assert pieces.walks == 1
    whole = summarize(recording)
    assert summary.peak_hysteresis_percent == pytest.approx(whole.peak_hysteresis_percent, rel=1e-9)
    assert "Results" in page(shown, summary)


def test_ticks_are_decimated(small, monkeypatch, recording):
    """Evenly, so that their distribution stays, and the latest."""
    monkeypatch.setattr(module, "_MOST_TICKS", 200)
    ticks = overview(Parts(recording))[1].ticks
    assert 90 < ticks.late_ns.size <= 202
    assert ticks.late_ns.max() == 9_000_000
    assert np.all(np.diff(ticks.first_sample) > 0)
    assert np.median(ticks.late_ns) == pytest.approx(np.median(recording.ticks.late_ns), rel=0.02)
