"""Figures: what is drawn in them, and when there is none."""

from dataclasses import replace

import numpy as np
import pytest
from matplotlib.collections import PolyCollection

from hilctl.base.segments import Segment
from hilctl.lab.pages import plot_style
from hilctl.lab.pages.figure_layout import drawn
from hilctl.lab.run_report import plots
from hilctl.lab.run_report.plots import before_and_after, error_spectrum, hysteresis_loop
from hilctl.recording.recording import Recording, Ticks

PERIOD = 1000.0


@pytest.fixture
def run(make_recording):
    """Return a builder of runs with that many steady cycles and a safe ramp."""

    def make(cycles: int = 4, *, compensated: bool = True, lag: float = 0.1) -> Recording:
        n = int(PERIOD * cycles)
        phase = 2.0 * np.pi * np.arange(n + 300) / PERIOD
        wave = 40.0 * np.sin(phase)
        reference_um = np.where(np.arange(n + 300) < n, wave, np.nan)
        return make_recording(
            40.0 * np.sin(phase - lag),
            reference_um=reference_um if compensated else None,
            command=wave / 7.0,
            ramp=300,
            segments=[Segment("sine $_x$ <40> um", 0, n, 0, n, PERIOD)],
        )

    return make


def lines(axes) -> dict[str, object]:
    return {line.get_label(): line for line in axes.get_lines()}


class TestTimeHistory:
    def test_many_cycles_are_a_band(self, run) -> None:
        upper = drawn(plots.time_history(run(cycles=400))).axes[0]
        bands = [c for c in upper.collections if isinstance(c, PolyCollection)]
        assert len(bands) == 1
        heights = bands[0].get_paths()[0].vertices[:, 1]
        assert np.abs(np.abs(heights) - 40.0).max() < 0.01

    def test_no_line_is_longer_than_a_plot_can_show(self, run) -> None:
        recording = replace(run(cycles=100), segments=())
        for sheet in (plots.time_history(recording), plots.error(recording)):
            for axes in drawn(sheet).axes:
                for line in axes.get_lines():
                    assert line.get_xdata().size <= plot_style.MAX_POINTS

    def test_run_without_a_reference_has_no_line_of_it(self, run) -> None:
        assert "reference" in lines(drawn(plots.steady_cycles(run())).axes[0])
        assert [*lines(drawn(plots.steady_cycles(run(compensated=False))).axes[0])] == [
            "displacement"
        ]

    def test_last_steady_cycles_stand_beside(self, run) -> None:
        close = drawn(plots.steady_cycles(run())).axes[0]
        start, stop = close.get_lines()[0].get_xdata()[[0, -1]]
        assert start == pytest.approx(2000 / 50_000)
        assert stop == pytest.approx(3999 / 50_000)


def test_the_largest_step_is_shown_until_it_settles(make_recording) -> None:
    wanted = np.repeat([0.0, 10.0, -20.0, 0.0], 2000)
    after = np.arange(2000) / 100.0
    moved = np.concatenate([wanted[:4000], 10.0 - 30.0 * (1.0 - np.exp(-after)), wanted[6000:]])
    part = Segment("step", 0, 8000, 0, 8000)
    recording = make_recording(moved, command=wanted, segments=[part])
    sheet = plots.step_response(recording)
    upper, _ = drawn(sheet).axes
    time_s, moved_um = lines(upper)["displacement"].get_data()
    np.testing.assert_allclose(np.interp(100 / 50_000, time_s, moved_um), -20.0 + 30.0 / np.e, 0.02)
    assert "6.02 ms" in sheet.caption  # three time constants and a sample
    assert plots.response(recording) is None


@pytest.mark.parametrize(("label", "period"), [("multisine", PERIOD), ("random", 0.0)])
def test_the_response_is_displacement_over_input(make_recording, label, period) -> None:
    turns = np.outer([3, 7, 11, 16], np.arange(8000)) / PERIOD
    wave = np.sin(2.0 * np.pi * turns).sum(axis=0)
    part = Segment(label, 0, 8000, 0, 8000, period)
    recording = make_recording(-2.5 * wave, command=wave, segments=[part])
    size = lines(drawn(plots.response(recording)).axes[0])["measured"].get_ydata()
    np.testing.assert_allclose(size, 2.5, rtol=1e-6)
    assert plots.step_response(recording) is None


class TestHysteresisLoop:
    @pytest.mark.parametrize("compensated", [True, False])
    def test_peak_hysteresis_is_marked_at_its_height(self, run, compensated: bool) -> None:
        figure = drawn(plots.hysteresis_loop(run(compensated=compensated)))
        for axes in figure.axes:
            assert axes.get_xlabel() == ("reference, µm" if compensated else "command, A")
            label = next(name for name in lines(axes) if name.startswith("peak hysteresis"))
            assert label.startswith(f"peak hysteresis {100.0 * np.sin(0.1):.3g} %")
            height = np.ptp(lines(axes)[label].get_ydata())
            assert height == pytest.approx(80.0 * np.sin(0.1), rel=1e-3)

    def test_what_does_not_repeat_is_drawn_as_measured(self, run) -> None:
        recording = run()
        once = replace(recording.segments[0], period=0.0)
        axes = drawn(plots.hysteresis_loop(replace(recording, segments=(once,)))).axes[0]
        assert axes.get_lines()[0].get_xdata().size == 4000
        assert not any(name.startswith("peak") for name in lines(axes))
        assert "not averaged" in axes.get_title("left")


class TestError:
    def test_peak_error_is_marked_on_the_average_cycle(self, run) -> None:
        _, phase = drawn(plots.error(run())).axes
        mark = lines(phase)["peak error"]
        assert abs(mark.get_ydata()[0]) == pytest.approx(80.0 * np.sin(0.05), rel=1e-3)

    def test_the_band_holds_every_sample_at_its_phase(self, run) -> None:
        recording = run()
        recording.samples.displacement_um[1250] += 5.0
        axes = drawn(plots.error(recording)).axes[1]
        band = axes.collections[0].get_paths()[0].vertices
        phase = np.abs(band[:, 0] - 0.25) < 0.004
        assert band[phase, 1].max() == pytest.approx(
            40.0 * (np.sin(np.pi / 2 - 0.1) - 1.0) + 5.0, abs=0.02
        )


class TestLateness:
    def test_every_tick_is_counted(self, run) -> None:
        late_ns = np.array([-5_000, 0, 40_000, 41_000, 3_000_000], dtype=np.int64)
        first = 50 * np.arange(5, dtype=np.int64)
        ticks = Ticks(first, 20_000 * first, late_ns, np.full(5, 30_000, dtype=np.int64))
        axes = drawn(plots.lateness(replace(run(), ticks=ticks))).axes[0]
        bars = axes.containers[0]
        assert sum(bar.get_height() for bar in bars) == 5
        assert (bars[0].get_x(), bars[0].get_height()) == (pytest.approx(1.0), 2)
        assert (axes.get_xscale(), axes.get_yscale()) == ("log", "log")
        assert {text.get_text() for text in axes.texts} >= {"p50 40.0 µs", "max 3.00 ms"}


class TestSpectrum:
    def test_harmonics_are_bars_in_nanometres(self, run) -> None:
        axes = drawn(plots.spectrum(run())).axes[1]
        heights = [bar.get_height() for bar in axes.containers[0]]
        assert heights[0] == pytest.approx(1e3 * 80.0 * np.sin(0.05), rel=1e-3)
        assert max(heights[1:]) < 1.0
        assert axes.get_ylabel() == "amplitude, nm"


def test_a_figure_without_data_is_none(run) -> None:
    """There are no samples, no whole cycle, no reference, no ticks, or no real time."""
    recording, plain = run(), run(compensated=False)
    samples = recording.samples
    ticks = Ticks(*(np.empty(0, np.int64),) * 4)
    assert plots.time_history(replace(recording, samples=samples.part(0, 0))) is None
    for more in ({"segments": ()}, {"samples": samples.part(0, 700)}):
        assert plots.hysteresis_loop(replace(recording, **more)) is None
    assert plots.error(plain) is plots.spectrum(plain) is None
    for more in ({"ticks": ticks}, {"run": {"paced": "false"}}):
        assert plots.lateness(replace(recording, **more)) is None


def test_pieces_cover_a_run_without_overlap(run) -> None:
    parts = (Segment("b", 2000, 3000, 2000, 3000, 10.0), Segment("a", 500, 1500, 500, 1500, 20.0))
    found = plot_style.pieces(replace(run(), segments=parts))
    assert found == [
        (0, 500, 0.0),
        (500, 1500, 20.0),
        (1500, 2000, 0.0),
        (2000, 3000, 10.0),
        (3000, 4300, 0.0),
    ]


N = 20_000
SEGMENT = Segment("sine", 0, N, 0, N, 500.0)


@pytest.fixture
def recording(make_recording):
    return make_recording(np.zeros(N), segments=[SEGMENT], sample_rate_hz=50_000.0)


def waves(index):
    turns = 2.0 * np.pi * index / SEGMENT.period
    return 0.3 + 0.2 * np.sin(turns + 0.4) + 0.05 * np.cos(3.0 * turns)


def test_lines_and_harmonics_have_the_amplitudes_of_their_sines(recording):
    index = np.arange(N)
    found = error_spectrum(recording, SEGMENT, index, waves(index))
    at = [int(np.argmin(np.abs(found.frequency_hz - hz))) for hz in (100.0, 300.0, 200.0)]
    assert found.amplitude_um[at] == pytest.approx([0.2, 0.05, 0.0], abs=1e-4)
    assert found.harmonics_um[:3] == pytest.approx([0.2, 0.0, 0.05], abs=1e-4)


def test_single_samples_may_be_missing_but_not_many(recording):
    index = np.delete(np.arange(N), [100, 5000])
    found = error_spectrum(recording, SEGMENT, index, waves(index))
    assert found.harmonics_um[0] == pytest.approx(0.2, rel=1e-2)
    half = np.arange(0, N, 2)
    assert error_spectrum(recording, SEGMENT, half, waves(half)) is None
    for senseless in (np.nan, 1e308):
        assert error_spectrum(recording, SEGMENT, index, np.full(index.size, senseless)) is None


SHORT_PERIOD = 500


def test_many_loops_are_not_all_named(make_recording):
    """A long legend has only the first, the last and the worst."""
    wave_um = 10.0 * np.sin(2.0 * np.pi * np.arange(40 * SHORT_PERIOD) / SHORT_PERIOD)

    def named(count):
        size = 40 * SHORT_PERIOD // count
        parts = [
            Segment(f"part {i}", i * size, (i + 1) * size, i * size, (i + 1) * size, SHORT_PERIOD)
            for i in range(count)
        ]
        recording = make_recording(wave_um, reference_um=wave_um, segments=parts)
        figure = drawn(hysteresis_loop(recording))
        return [text.get_text() for text in figure.legends[0].get_texts()]

    assert [name for name in named(4) if "part" in name] == [f"part {i}" for i in range(4)]
    assert [name for name in named(20) if "part" in name] == ["part 0", "part 19"]


def test_before_and_after_are_drawn_over_their_own_ranges(make_recording):
    """Command and reference have different units; both go from corner to corner."""
    phase = 2.0 * np.pi * np.arange(4 * SHORT_PERIOD) / SHORT_PERIOD
    part = [Segment("sine", 0, 4 * SHORT_PERIOD, 0, 4 * SHORT_PERIOD, SHORT_PERIOD)]
    before = make_recording(40.0 * np.sin(phase - 0.3), command=6.0 * np.sin(phase), segments=part)
    wave_um = 40.0 * np.sin(phase)
    after = make_recording(wave_um, reference_um=wave_um, segments=part)
    left, right = drawn(before_and_after(before, after)).axes
    for line in left.lines[:2]:
        assert (line.get_ydata().min(), line.get_ydata().max()) == pytest.approx((0.0, 100.0))
    assert np.ptp(right.lines[0].get_ydata()) == pytest.approx(100.0 * np.sin(0.3), rel=0.02)
    assert np.ptp(right.lines[1].get_ydata()) == pytest.approx(0.0, abs=1e-9)
    assert before_and_after(make_recording(wave_um), after) is None


def test_constant_command_has_a_level_line(make_recording):
    part = Segment("constant", 0, 1000, 0, 1000, 0.0)
    displacement_um = np.linspace(1.0, 3.0, 1000)
    recording = make_recording(displacement_um, command=np.full(1000, 2.0), segments=[part])
    figure = drawn(hysteresis_loop(recording))
    off_the_line = figure.axes[1].lines[0].get_ydata()
    np.testing.assert_allclose(off_the_line, displacement_um - 2.0)
