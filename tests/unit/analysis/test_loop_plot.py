"""The figure of the hysteresis loop: what is drawn where nothing was recorded or moved."""

import numpy as np
import pytest

from hilctl.analysis.figure_layout import drawn
from hilctl.analysis.loop_plot import before_and_after, hysteresis_loop
from hilctl.base.segments import Segment

PERIOD = 500


def test_many_loops_are_not_all_named(make_recording):
    """A legend longer than the figure says nothing: the first, the last and the worst do."""
    wave_um = 10.0 * np.sin(2.0 * np.pi * np.arange(40 * PERIOD) / PERIOD)

    def named(count):
        size = 40 * PERIOD // count
        parts = [
            Segment(f"part {i}", i * size, (i + 1) * size, i * size, (i + 1) * size, PERIOD)
            for i in range(count)
        ]
        recording = make_recording(wave_um, reference_um=wave_um, segments=parts)
        figure = drawn(hysteresis_loop(recording))
        return [text.get_text() for text in figure.legends[0].get_texts()]

    assert [name for name in named(4) if "part" in name] == [f"part {i}" for i in range(4)]
    assert [name for name in named(20) if "part" in name] == ["part 0", "part 19"]


def test_before_and_after_are_drawn_over_their_own_ranges(make_recording):
    """Command and reference have different units; both go from corner to corner."""
    phase = 2.0 * np.pi * np.arange(4 * PERIOD) / PERIOD
    part = [Segment("sine", 0, 4 * PERIOD, 0, 4 * PERIOD, PERIOD)]
    before = make_recording(40.0 * np.sin(phase - 0.3), command=6.0 * np.sin(phase), segments=part)
    wave_um = 40.0 * np.sin(phase)
    after = make_recording(wave_um, reference_um=wave_um, segments=part)
    left, right = drawn(before_and_after(before, after)).axes
    for line in left.lines[:2]:
        assert (line.get_ydata().min(), line.get_ydata().max()) == pytest.approx((0.0, 100.0))
    assert np.ptp(right.lines[0].get_ydata()) == pytest.approx(100.0 * np.sin(0.3), rel=0.02)
    assert np.ptp(right.lines[1].get_ydata()) == pytest.approx(0.0, abs=1e-9)
    assert before_and_after(make_recording(wave_um), after) is None


def test_a_command_that_stands_has_a_level_line(make_recording):
    part = Segment("constant", 0, 1000, 0, 1000, 0.0)
    displacement_um = np.linspace(1.0, 3.0, 1000)
    recording = make_recording(displacement_um, command=np.full(1000, 2.0), segments=[part])
    figure = drawn(hysteresis_loop(recording))
    off_the_line = figure.axes[1].lines[0].get_ydata()
    np.testing.assert_allclose(off_the_line, displacement_um - 2.0)
