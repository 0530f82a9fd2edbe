"""Contour errors against closed forms, in pieces, and the recordings of one run."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from hilctl.analysis import contour as module
from hilctl.analysis.contour import average_contour, contour
from hilctl.base.errors import DataError
from hilctl.base.samples import Flag
from hilctl.base.segments import Segment
from hilctl.base.types import F64
from hilctl.recording.recording import Recording, Ticks

RATE_HZ = 10_000.0
RADIUS_UM = 30.0
Made = Callable[..., Recording]


def segment(size: int, period: float = 0.0, label: str = "sine", soft: int = 0) -> Segment:
    return Segment(label, 0, size, soft, size, period)


def angle(size: int, period: float) -> F64:
    return 2.0 * np.pi * np.arange(size) / period


@pytest.fixture
def axis(make_recording: Made) -> Made:
    """Build the recording of one axis."""

    def make(reference_um: F64, measured_um: F64, period: float = 0.0, **more: Any) -> Recording:
        segments = more.pop("segments", [segment(reference_um.size, period)])
        return make_recording(
            measured_um,
            reference_um=reference_um,
            segments=segments,
            sample_rate_hz=RATE_HZ,
            **more,
        )

    return make


@pytest.fixture
def circle(axis: Made) -> Callable[..., dict[str, Recording]]:
    """Build two axes that follow a circle with equal lag, and another radius."""

    def make(lag: float = 0.0, growth_um: float = 0.0, period: int = 500, cycles: int = 6):
        phase = angle(cycles * period, period)
        steady = replace(segment(phase.size, period), steady_stop=phase.size - period)
        waves = {"x": np.cos, "y": np.sin}
        return {
            name: axis(
                RADIUS_UM * f(phase), (RADIUS_UM + growth_um) * f(phase - lag), segments=[steady]
            )
            for name, f in waves.items()
        }

    return make


def in_pieces(recording: Recording, size: int) -> list[Recording]:
    total = recording.samples.index.size
    cuts = range(0, total, size)
    ticks = recording.ticks
    pieces = []
    for cut in cuts:
        of = (cut <= ticks.first_sample) & (ticks.first_sample < cut + size)
        rows = recording.samples.part(cut, cut + size)
        pieces.append(replace(recording, samples=rows, ticks=ticks.rows(of), end={}))
    return [*pieces[:-1], replace(pieces[-1], end=recording.end)]


def whole(runs: dict[str, Recording]) -> dict[str, list[Recording]]:
    return {name: [each] for name, each in runs.items()}


class TestCircle:
    @pytest.mark.parametrize("growth_um", [-2.0, 0.05, 3.0])
    def test_radius_error(self, circle, growth_um):
        report, _ = contour(whole(circle(growth_um=growth_um)))
        flat = RADIUS_UM * (1.0 - np.cos(np.pi / 500))  # of the chords between samples
        for value in (report.peak_um, report.rms_um, report.mean_um):
            assert value == pytest.approx(abs(growth_um), abs=2.0 * flat)
        assert report.along_peak_um == pytest.approx(0.0, abs=0.02)
        assert report.samples == 2000
        assert report.limited_samples == 0

    @pytest.mark.parametrize("lag", [0.3, -0.3, 1.8])
    def test_equal_lag_is_no_contour_error(self, circle, lag):
        report, _ = contour(whole(circle(lag=lag)))
        assert report.peak_um < RADIUS_UM * (1.0 - np.cos(np.pi / 500)) * 1.01
        assert report.along_mean_um == pytest.approx(-lag * RADIUS_UM, rel=1e-3)
        assert report.along_rms_um == pytest.approx(abs(lag) * RADIUS_UM, rel=1e-3)
        assert report.lag_s == pytest.approx(lag / (2.0 * np.pi * 20.0), rel=1e-3)

    def test_lag_beyond_the_reach_is_counted(self, circle, monkeypatch):
        monkeypatch.setattr(module, "MOST_REACH", 125)
        report, _ = contour(whole(circle(lag=1.8)))
        assert (report.limited_samples, report.samples) == (2000, 2000)
        assert report.peak_um == pytest.approx(2.0 * RADIUS_UM * np.sin(0.9 - np.pi / 4), rel=1e-2)

    def test_phase_error_between_axes_makes_an_ellipse(self, axis):
        """Of a small phase error p, the half axes are R sqrt(1 +- sin p)."""
        phase, error = angle(2500, 500), 0.02
        x, y = RADIUS_UM * np.cos(phase), RADIUS_UM * np.sin(phase)
        runs = {"x": axis(x, x, 500.0), "y": axis(y, RADIUS_UM * np.sin(phase - error), 500.0)}
        report, _ = contour(whole(runs))
        assert report.peak_um == pytest.approx(RADIUS_UM * error / 2.0, rel=0.03)

    @pytest.mark.parametrize("sizes", [(700, 300), (100, 2500), (64, 64)])
    def test_pieces_give_the_same(self, circle, monkeypatch, sizes):
        """Whatever the pieces of the axes, a trace has the last samples, once around."""
        runs = circle(lag=0.2, growth_um=0.1)
        expected, (trace,) = contour(whole(runs))
        monkeypatch.setattr(module, "_TOGETHER", 100)
        monkeypatch.setattr(module, "MOST_REACH", 100)
        cut = {
            name: in_pieces(run, size)
            for (name, run), size in zip(runs.items(), sizes, strict=True)
        }
        found, (last,) = contour(cut)
        assert found.peak_um == pytest.approx(expected.peak_um, rel=1e-12)
        assert found.rms_um == pytest.approx(expected.rms_um, rel=1e-12)
        assert found.along_mean_um == pytest.approx(expected.along_mean_um, rel=1e-9)
        assert (found.samples, found.skew_us) == (expected.samples, expected.skew_us)
        assert last.index.size == trace.index.size == 501
        np.testing.assert_allclose(last.nearest_um, trace.nearest_um, rtol=0.0, atol=1e-9)
        np.testing.assert_allclose(last.error_um, trace.error_um, rtol=0.0, atol=1e-9)


def check(axis: Made, path: F64, measured: F64, periods: Sequence[float] = (0.0, 0.0)):
    """Return what is found of the samples that are neither at the start nor at the end."""
    size = len(path)
    runs = {}
    for k, name in enumerate("xyz"[: path.shape[1]]):
        steady = Segment("path", 0, size, 400, size - 400, periods[k % 2])
        runs[name] = axis(path[:, k], measured[:, k], segments=[steady])
    return contour(whole(runs))


def test_line(axis):
    """Displaced across by 0.3 um and behind by 2 um, in three axes."""
    along, across = np.array([2.0, 1.0, 2.0]) / 3.0, np.array([1.0, -2.0, 0.0]) / np.sqrt(5.0)
    path = np.outer(np.arange(2000) * 0.01, along)
    report, _ = check(axis, path, path + 0.3 * across - 2.0 * along)
    assert report.peak_um == pytest.approx(0.3, rel=1e-9)
    assert report.along_mean_um == pytest.approx(-2.0, rel=1e-9)
    assert report.lag_s == pytest.approx(200 / RATE_HZ, rel=1e-9)


def test_corner_is_cut(axis):
    """A lag of each axis rounds the corner of a square path; on the sides it is no error."""
    side = np.arange(1000) * 0.02
    x = np.concatenate([side, np.full(1000, 20.0)])
    y = np.concatenate([np.zeros(1000), side])
    lag = np.exp(-np.arange(500) / 50.0)
    lag /= lag.sum()
    measured = np.column_stack([np.convolve(each, lag)[:2000] for each in (x, y)])
    report, (trace,) = check(axis, np.column_stack([x, y]), measured)
    corner = int(np.argmax(trace.error_um))
    assert 1000 <= trace.index[corner] < 1100
    assert trace.error_um[trace.index < 1000].max() < 1e-9
    assert 0.2 < report.peak_um < 1.0
    assert report.lag_s == pytest.approx(49.5 / RATE_HZ, rel=0.15)


def test_crossing_of_a_lissajous_figure(axis):
    """Beside a crossing, the other branch is nearer and is not taken."""
    period = 6000
    t = angle(3 * period, period)
    path = np.column_stack([np.sin(3.0 * t), np.sin(4.0 * t + 0.4)]) * RADIUS_UM
    tangent = np.gradient(path, axis=0)
    tangent /= np.linalg.norm(tangent, axis=1)[:, None]
    measured = path + 0.2 * np.column_stack([-tangent[:, 1], tangent[:, 0]])
    report, (trace,) = check(axis, path, measured, (period / 3, period / 4))
    assert report.mean_um == pytest.approx(0.2, rel=1e-2)
    assert report.peak_um == pytest.approx(0.2, rel=1e-2)
    assert trace.index.size == period + 1
    crossing = [
        np.linalg.norm(path[:period] - point, axis=1).min() < 0.05 for point in trace.measured_um
    ]
    assert np.count_nonzero(crossing) > 10
    np.testing.assert_allclose(trace.error_um[crossing], 0.2, rtol=0.02)


def test_turns_of_a_spiral_are_told_apart(axis):
    """A point is 1.5 um outside its own turn and 0.5 um inside the next."""
    t = angle(10_000, 500)
    radius = 2.0 * t / (2.0 * np.pi)  # a turn is 2 um beside the one before
    path = radius[:, None] * np.column_stack([np.cos(t), np.sin(t)])
    outside = (radius + 1.5)[:, None] * np.column_stack([np.cos(t), np.sin(t)])
    report, _ = check(axis, path, outside)
    assert report.mean_um == pytest.approx(1.5, rel=0.05)


def test_flyback_of_a_raster_is_no_nearer_branch(axis):
    """Lines of 100 um, a flyback to the next line 1 um above, and y 0.3 um too high."""
    x = np.tile(np.concatenate([np.arange(0.0, 100.0, 0.2), np.arange(100.0, 0.0, -1.0)]), 5)
    step = np.concatenate([np.zeros(500), np.linspace(0.0, 1.0, 100)])
    y = np.concatenate([step + line for line in range(5)])
    path = np.column_stack([x, y])
    report, _ = check(axis, path, path + np.array([0.0, 0.3]))
    assert report.peak_um == pytest.approx(0.3, rel=0.02)
    assert report.along_peak_um < 1.5


def test_rejected_and_missing_samples_are_left_out(circle):
    runs = circle(growth_um=1.0)
    y = runs["y"].samples
    flags = y.flags.copy()
    flags[1200:1210] = Flag.SENSOR_INVALID
    displacement_um = y.displacement_um.copy()
    displacement_um[1200:1210], displacement_um[1300] = 1e3, np.nan
    spoilt = replace(y, flags=flags, displacement_um=displacement_um)
    runs["y"] = replace(
        runs["y"], samples=spoilt.rows(np.delete(np.arange(2500), slice(1400, 1420)))
    )
    report, _ = contour(whole(runs))
    assert report.samples == 2000 - 10 - 1 - 20
    assert report.peak_um == pytest.approx(1.0, rel=0.02)


def test_only_common_evaluated_samples_count(axis):
    """x has two segments and a soft start, y one and ended early."""
    size = 3000
    t = angle(size, 500)
    x = [Segment("sine", 0, 1500, 250, 1500, 500.0), Segment("hold", 1500, size, 1500, size)]
    wave = RADIUS_UM * np.sin(t)
    runs = {
        "x": axis(wave, wave + 0.5, segments=x),
        "y": axis(wave[:2000], wave[:2000], segments=[Segment("path", 0, size, 0, size)]),
    }
    report, traces = contour(whole(runs))
    assert [each.labels for each in report.segments] == [("sine", "path"), ("hold", "path")]
    assert [each.samples for each in report.segments] == [500, 500]
    assert report.samples == 1000
    assert len(traces) == 2
    assert report.axes["x"].samples == size


def test_no_reference_no_contour(make_recording):
    free = make_recording(np.zeros(100), segments=[segment(100)], sample_rate_hz=RATE_HZ)
    report, (trace,) = contour({"x": [free], "y": [free]})
    assert (report.samples, report.peak_um, report.lag_s, trace) == (0, None, None, None)
    assert report.to_mapping()["axes"]["y"]["samples"] == 100


def test_rates_must_be_one(circle):
    runs = circle()
    runs["y"] = replace(runs["y"], sample_rate_hz=5000.0)
    with pytest.raises(DataError, match="y: 5000 Hz"):
        contour(whole(runs))


def test_skew_is_the_difference_of_the_times_of_exchange(circle):
    runs = circle()
    late_ns = np.arange(50, dtype=np.int64) * 1000
    first = np.arange(50, dtype=np.int64) * 50
    for name, after_ns in {"x": late_ns, "y": late_ns + 1500 + 500 * (first == 500)}.items():
        ticks = Ticks(first, first * 100_000, after_ns, np.zeros_like(first))
        runs[name] = replace(runs[name], ticks=ticks if name == "x" else ticks.rows(first != 50))
    skew_us = contour(whole(runs))[0].skew_us
    assert skew_us == {"y": {"mean": pytest.approx(1.5 + 0.5 / 49), "max": pytest.approx(2.0)}}


class TestAverage:
    """The contour error of the average cycle, in percent of the largest peak-to-peak reference."""

    def test_a_larger_circle(self, circle):
        runs = circle(growth_um=0.3)
        percent = average_contour([*runs.values()], runs["x"].segments[0])
        assert percent == pytest.approx(0.3 / (2.0 * RADIUS_UM) * 100.0, rel=1e-3)

    def test_a_lag_is_no_contour_error(self, circle):
        runs = circle(lag=0.05)
        assert average_contour([*runs.values()], runs["x"].segments[0]) < 0.01

    def test_noise_is_averaged(self, axis):
        phase, random = angle(40 * 500, 500), np.random.default_rng(1)
        runs = {
            name: axis(
                RADIUS_UM * f(phase),
                RADIUS_UM * f(phase) + random.normal(0.0, 0.1, phase.size),
                500,
            )
            for name, f in {"x": np.cos, "y": np.sin}.items()
        }
        percent = average_contour([*runs.values()], runs["x"].segments[0])
        single, _ = contour(whole(runs))
        assert percent * 0.01 * 2.0 * RADIUS_UM < 0.3 * single.peak_um

    def test_without_a_cycle_there_is_none(self, circle):
        runs = circle()
        steady = replace(runs["x"].segments[0], steady_stop=100)
        assert average_contour([*runs.values()], steady) is None
