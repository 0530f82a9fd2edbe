"""Metrics of loops and reversal curves, repeatability, growth of amplitudes."""

import math
from dataclasses import replace

import numpy as np
import pytest

from hilctl.base.errors import DataError
from hilctl.base.segments import Segment
from hilctl.studies.characterise.loops import (
    LoopFigures,
    all_loops,
    centre_line,
    loop_figures,
    next_amplitude,
    repeatability,
    reversal_curves,
)
from hilctl.studies.characterise.response import RigProblemError
from hilctl.studies.characterise.waveforms import biased_loops, sine
from hilctl.studies.characterise.waveforms import reversal_curves as reversal_keys
from tests.unit.studies.characterise.conftest import plays


def loop(limits, played, actuator=plays, amplitude=2.0, noise_um=0.01):
    run = played(limits, sine(limits, amplitude, limits.middle_hz, 8.0), actuator, noise_um)
    return loop_figures(run, run.segments[-1])


def test_figures_of_a_loop(limits, played):
    """p-p: 2 x (3 x 2 + 4 x 1.7 + 2 x 1) um."""
    found = loop(limits, played)
    assert found.peak_to_peak_um == pytest.approx(29.6, rel=0.01)
    assert found.amplitude == pytest.approx(2.0, rel=1e-3)
    assert found.bias == pytest.approx(0.0, abs=1e-3)
    assert found.gain_um == pytest.approx(7.4, rel=0.01)
    assert found.hysteresis_percent == pytest.approx(100.0 * (2 * 0.3 * 4 + 2 * 2) / 29.6, rel=0.03)
    assert found.scatter_percent < 0.1


def test_the_centre_line_is_the_mean_of_both_branches(limits, played):
    """Those of plays are symmetric, and the largest loop of them turns at +-2 A."""
    line = centre_line(loop(limits, played, noise_um=0.0))
    assert (line[0], line[-1]) == pytest.approx((-2.0, 2.0), abs=0.01)
    assert line == pytest.approx(-line[::-1], abs=0.02)
    assert np.all(np.diff(line) > 0.0)


def test_cycles_that_differ_scatter(limits, played):
    """A mounting that slips by 3 um in each cycle."""
    found = loop(limits, played, lambda v: plays(v) + np.floor(np.arange(v.size) / 790.0) % 2 * 3.0)
    assert found.scatter_percent > 2.0


def test_a_sensor_at_its_end_is_a_problem(limits, played):
    with pytest.raises(RigProblemError, match="10 µm") as caught:
        loop(limits, played, lambda v: np.minimum(plays(v), 10.0), noise_um=0.0)
    assert caught.value.code == "saturated_sensor"


def test_a_coarse_sensor_is_not_at_its_end(limits, played):
    """With forty distinct readings, equal extremes are no saturation."""
    loop(limits, played, lambda v: np.round(plays(v)), noise_um=0.0)


def test_a_segment_without_a_cycle_has_no_loop(make_recording):
    run = make_recording(np.zeros(100), segments=[Segment("chirp", 0, 100, 0, 100)])
    assert all_loops(run) == ()
    with pytest.raises(DataError, match="steady cycle"):
        loop_figures(run, run.segments[0])


def test_small_loops_have_their_places(limits, played):
    run = played(limits, biased_loops(limits, 3.0), plays)
    found = all_loops(run)
    assert [each.bias for each in found] == pytest.approx([2.1, 1.05, 0.0, -1.05, -2.1], abs=0.02)
    assert all(each.amplitude == pytest.approx(0.45, rel=1e-2) for each in found)


LOOP = LoopFigures("x", 1.0, 0.0, 5.0, -5.0, 5.0, 10.0, 0.0, np.zeros(4), np.zeros(4))


def grown(*sizes):
    """Return loops of given amplitudes and displacements."""
    return [replace(LOOP, amplitude=a, low_um=-y, high_um=y) for a, y in sizes]


@pytest.mark.parametrize(("loops", "wanted", "chosen"), [
    ([], 0.4, 0.4),
    ([(0.4, 2.0)], 1.0, 1.0),
    ([(1.0, 10.0), (2.0, 46.0)], 4.0, None),
    ([(2.0, 60.0)], 4.0, None),
    ([(2.0, 5.0), (2.0, 5.0)], 2.0, None),
])  # fmt: skip
def test_amplitudes_grow_while_there_is_room(loops, wanted, chosen):
    assert next_amplitude(grown(*loops), wanted, (-50.0, 50.0)) == chosen


def test_growth_stops_short_of_the_stroke():
    """Displacement is quadratic here: 57.6 um at 2.4."""
    loops = grown((1.0, 10.0), (2.0, 40.0))
    chosen = next_amplitude(loops, 4.0, (-50.0, 50.0))
    assert 2.06 < chosen < 2.2
    assert 10.0 * chosen**2 < 48.0


def test_an_uneven_stroke_counts_on_its_narrow_side():
    assert next_amplitude(grown((1.0, 10.0)), 9.0, (-100.0, 17.0)) < 1.2


def test_repeatability_tells_shape_from_place():
    turns = np.linspace(0.0, 2.0 * np.pi, 100, endpoint=False)
    first = replace(LOOP, displacement_um=5.0 * np.sin(turns))
    again = replace(LOOP, displacement_um=5.0 * np.sin(turns) + 0.7 + 0.2 * np.sin(3.0 * turns))
    found = repeatability(first, again)
    assert found.shift_um == pytest.approx(0.7)
    assert found.shift_percent == pytest.approx(7.0)
    assert found.shape_percent == pytest.approx(2.0, rel=0.01)


def test_noise_is_no_change_of_shape(limits, played):
    """Sensor noise of 3 % of the peak-to-peak is no change of shape."""
    first, again = (loop(limits, played, noise_um=1.0 + 1e-9 * k) for k in range(2))
    again = replace(again, displacement_um=again.displacement_um + np.random.default_rng(5).normal(
        0.0, 0.35, again.displacement_um.size))  # fmt: skip
    assert repeatability(first, again).shape_percent < 1.0


def test_reversal_curves_return_to_one_point(limits, played):
    """Plays have return-point memory; a drifting actuator does not."""
    found = reversal_curves(played(limits, reversal_keys(limits, 3.0), plays))
    assert found.turns[0] == pytest.approx(-3.0, abs=0.05)
    assert list(found.turns[1:]) == sorted(found.turns[1:], reverse=True)
    assert len(found.curves) == len(found.turns) == 10
    assert found.return_percent < 0.1
    creeping = played(
        limits, reversal_keys(limits, 3.0), lambda v: plays(v) + 4.0 * np.arange(v.size) / v.size
    )
    assert reversal_curves(creeping).return_percent > 1.0


def test_coarse_samples_show_no_return_point(limits_with, played):
    slow = limits_with("sample_rate_hz=20", "block=1", "limits.slew_a_per_s=15.0")
    found = reversal_curves(played(slow, reversal_keys(slow, 3.0), plays))
    assert len(found.curves) == 10
    assert math.isnan(found.return_percent)
