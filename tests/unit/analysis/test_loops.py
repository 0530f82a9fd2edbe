"""The figure of the hysteresis loop: what is drawn where nothing was recorded or moved."""

import numpy as np

from hilctl.analysis.loops import hysteresis_loop
from hilctl.base.segments import Segment

PERIOD = 500


def test_loops_beyond_three_are_named_beside_the_axes(make_recording):
    """Few loops are named in the corner they leave free; many would lie over the loops."""
    wave_um = 10.0 * np.sin(2.0 * np.pi * np.arange(12 * PERIOD) / PERIOD)

    def drawn(count):
        size = 12 * PERIOD // count
        parts = [
            Segment(f"part {i}", i * size, (i + 1) * size, i * size, (i + 1) * size, PERIOD)
            for i in range(count)
        ]
        return hysteresis_loop(make_recording(wave_um, reference_um=wave_um, segments=parts))

    few, many = drawn(2), drawn(4)
    assert few.axes[0].get_legend() is not None
    assert few.legends == []
    assert many.axes[0].get_legend() is None
    assert [text.get_text() for text in many.legends[0].get_texts()][-4:] == [
        f"part {i}" for i in range(4)
    ]


def test_a_command_that_stands_has_a_level_line(make_recording):
    """No slope can be found from one input: the line is the mean, and no figure is lost."""
    part = Segment("constant", 0, 1000, 0, 1000, 0.0)
    displacement_um = np.linspace(1.0, 3.0, 1000)
    figure = hysteresis_loop(
        make_recording(displacement_um, command=np.full(1000, 2.0), segments=[part])
    )
    off_the_line = figure.axes[1].lines[0].get_ydata()
    np.testing.assert_allclose(off_the_line, displacement_um - 2.0)
