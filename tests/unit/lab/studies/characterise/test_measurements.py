"""Noise, first reaction, small-signal response, loops, reversal curves, growth of amplitudes."""

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import cont2discrete, lfilter

from hilctl.base.errors import DataError
from hilctl.base.segments import Segment
from hilctl.lab.studies.characterise.measurements import (
    LocalResonance,
    LoopMetrics,
    RigProblemError,
    all_loops,
    centre_line,
    compliance_of,
    crept_percent,
    loop_metrics,
    next_amplitude,
    noise_at_rest,
    repeatability,
    reversal_curves,
    sine_reaction,
    small_signal,
)
from hilctl.lab.studies.characterise.waveforms import (
    at_rest,
    biased_loops,
    rests,
    sine,
    small_multisine,
)
from hilctl.lab.studies.characterise.waveforms import reversal_curves as reversal_keys
from hilctl.models.linear_stages import CreepModel
from tests.unit.lab.studies.characterise.conftest import plays


def test_a_sensor_without_numbers_is_a_problem(limits, played):
    assert noise_at_rest(played(limits, at_rest(limits), lambda v: 0.0 * v)).noise_um == 0.0
    with pytest.raises(RigProblemError, match="10000 of 10000") as caught:
        noise_at_rest(played(limits, at_rest(limits), lambda v: v + np.nan))
    assert caught.value.code == "no_reading"


def reaction(limits, played, actuator, **more):
    keys = sine(limits, 0.04, limits.middle_hz, 12.0)
    return sine_reaction(played(limits, keys, actuator, **more))


@pytest.mark.parametrize("gain_um", [4.0, -4.0])
def test_a_reaction_far_below_the_noise_shows_with_its_sign(limits, played, gain_um):
    """A motion of 0.16 um in noise of 0.2 um rms."""
    found = reaction(limits, played, lambda v: 3.0 + gain_um * v, noise_um=0.2)
    assert found.clear
    assert not found.even
    assert found.gain_um == pytest.approx(gain_um, rel=0.2)
    assert abs(found.gain_um - gain_um) < 6.0 * found.doubt_um
    assert found.amplitude == pytest.approx(0.04, rel=1e-3)


@pytest.mark.parametrize("seed", range(5))
def test_noise_alone_is_no_reaction(limits, played, seed):
    found = reaction(limits, played, lambda v: 0.0 * v, noise_um=0.5, seed=seed)
    assert not found.clear
    assert not found.even


def test_a_rod_without_bias_reacts_alike_to_both_signs(limits, played):
    assert reaction(limits, played, lambda v: 50.0 * v**2, noise_um=0.001).even


@pytest.mark.parametrize(
    ("actuator", "noise_um"),
    [(lambda v: 0.0 * v + 2.0, 0.0), (lambda v: 5.0 * np.arange(v.size) / v.size, 0.05)],
    ids=["constant", "drift"],
)
def test_a_constant_reading_or_drift_is_no_reaction(limits, played, actuator, noise_um):
    assert not reaction(limits, played, actuator, noise_um=noise_um).clear


def test_the_phase_is_that_of_a_delay(limits, played):
    found = reaction(limits, played, lambda v: 4.0 * np.roll(v, 10))
    assert found.angle_deg == pytest.approx(360.0 * found.frequency_hz * 10 / 5000.0, rel=0.05)


def test_a_motion_a_quarter_of_a_cycle_late_has_no_sign(limits, played):
    late = round(0.25 * 5000.0 / limits.middle_hz)
    found = reaction(limits, played, lambda v: 0.1 * np.roll(v, late), noise_um=0.002)
    assert abs(found.gain_um) > 6.0 * found.doubt_um
    assert not found.clear


def test_a_segment_says_where_the_sine_is(make_recording):
    """A ramp before the segment is ignored."""
    index = np.arange(3000)
    command = np.where(index < 500, 1.0, np.sin(2.0 * np.pi * (index - 500) / 250.0))
    segment = Segment("sine", 500, 3000, 500, 3000, 250.0)
    run = make_recording(2.0 * command, command=command, segments=[segment])
    assert sine_reaction(run).gain_um == pytest.approx(2.0)


def test_what_creeps_in_a_rest_is_told_of_where_it_stands(limits, played):
    """Creep at both ends, with an offset at rest; none without creep."""
    creep = CreepModel(time_constants_s=(0.02, 3.0), shares=(0.1, 0.05))

    def creeping(command):
        x_um = 5.0 * command + 12.0
        return creep.forward(limits.sample_rate_hz, rest_um=x_um[0]).process(x_um)

    keys = rests(limits, limits.reach)
    found = crept_percent(played(limits, keys, creeping, noise_um=0.01))
    # After 0.1 s the element of 0.02 s has settled. The other one must return from the first side.
    rested_s = keys["parts"][1]["dwell_s"] - keys["parts"][1]["rise_s"] - 0.2
    once = 5.0 / 1.1 * -np.expm1(-rested_s / 3.0)
    assert found[0] == pytest.approx(once, rel=0.1)
    assert 0.65 * once < found[1] < once  # of twice the motion
    still = crept_percent(played(limits, keys, lambda v: 5.0 * v + 12.0, noise_um=0.01))
    assert still == pytest.approx([0.0, 0.0], abs=0.05)


RATE_HZ = 5000.0


def resonator(natural_hz, damping_ratio):
    """Return a second-order resonator of gain 1, driven by held commands."""
    omega = 2.0 * np.pi * natural_hz
    continuous = [1.0], [omega**-2, 2.0 * damping_ratio / omega, 1.0]
    b, a, _ = cont2discrete(continuous, 1.0 / RATE_HZ, method="zoh")
    return lambda v: lfilter(b[0], a, v)


def response(limits, played, actuator, noise_um=0.01):
    return small_signal(played(limits, small_multisine(limits, 0.2), actuator, noise_um))


def test_a_resonance_is_found(limits, played):
    structure = resonator(400.0, 0.08)
    found = response(limits, played, lambda v: 4.0 * structure(v))
    assert found.natural_hz == pytest.approx(400.0, rel=0.03)
    assert found.damping_ratio == pytest.approx(0.08, rel=0.15)
    assert found.gain_um == pytest.approx(4.0, rel=0.05)
    assert found.size_at(400.0) > 4.0
    assert found.misfit_percent < 10.0


def test_a_compliance_follows_from_resonances_that_differ():
    """It is relative to the first place, and constant beyond the others."""
    places = [LocalResonance(0.0, 1000.0, 2.0), LocalResonance(-8.0, 800.0, 2.0)]
    found = compliance_of(places, (-12.0, 4.0))
    assert (found.lowest_um, found.cell_um) == (-12.0, 1.0)
    relative = dict(zip(range(-12, 5), found.relative, strict=True))
    assert relative[-12] == relative[-8] == pytest.approx(1.5625)
    assert relative[-4] == pytest.approx(1.28125)
    assert relative[4] == relative[0] == pytest.approx(1.0)


@pytest.mark.parametrize("other", [(1020.0, 1.0), (1200.0, 60.0)])
def test_a_resonance_that_hardly_differs_is_the_same_everywhere(other):
    places = [LocalResonance(0.0, 1000.0, 2.0), LocalResonance(-8.0, *other)]
    assert compliance_of(places, (-12.0, 4.0)) is None
    assert compliance_of(places[:1], (-12.0, 4.0)) is None


def test_a_lag_and_a_delay_are_no_resonance(limits, played):
    """A delay of three samples and a low-pass of 1 ms."""
    kept = np.exp(-1.0 / (RATE_HZ * 1e-3))
    found = response(
        limits, played, lambda v: -2.0 + 4.0 * np.roll(lfilter([1 - kept], [1, -kept], v), 3)
    )
    assert found.natural_hz is None
    assert found.lag_s == pytest.approx(1e-3, rel=0.2)
    # These actuators answer at once: half a sample before the middle of a held command.
    assert found.delay_s == pytest.approx(2.5 / RATE_HZ, abs=0.5 / RATE_HZ)
    assert found.gain_um == pytest.approx(4.0, rel=0.02)


@pytest.mark.parametrize("drift_um", [0.0, 5.0])
def test_a_plain_gain_has_neither(limits, played, drift_um):
    found = response(limits, played, lambda v: 4.0 * v + drift_um * np.arange(v.size) / v.size)
    assert found.natural_hz is None
    assert found.gain_um == pytest.approx(4.0, rel=0.02)
    assert found.lag_s < 2e-5
    assert found.delay_s == pytest.approx(-0.5 / RATE_HZ, abs=0.1 / RATE_HZ)


def test_noise_over_everything_is_a_problem(limits, played):
    with pytest.raises(RigProblemError, match="above the noise") as caught:
        response(limits, played, lambda v: 0.001 * v, noise_um=1.0)
    assert caught.value.code == "noise"


def test_a_few_readings_that_are_no_numbers_do_no_harm_many_do(limits, played):
    def found(every):
        def moved(v):
            return np.where(np.arange(v.size) % every, 4.0 * v, np.nan)

        return response(limits, played, moved)

    assert found(200).gain_um == pytest.approx(4.0, rel=0.05)
    with pytest.raises(RigProblemError, match="missing") as caught:
        found(20)
    assert caught.value.code == "no_reading"


def loop(limits, played, actuator=plays, amplitude=2.0, noise_um=0.01):
    run = played(limits, sine(limits, amplitude, limits.middle_hz, 8.0), actuator, noise_um)
    return loop_metrics(run, run.segments[-1])


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
        loop_metrics(run, run.segments[0])


def test_biased_loops_have_their_places_and_begin_from_rest(limits, played):
    run = played(limits, biased_loops(limits, 3.0), plays)
    found = all_loops(run)
    places = [0.0, 1.35, -1.35, 2.1, -2.1, 2.55, 0.0, -2.55]
    sizes = [2.85, 1.5, 1.5, 0.75, 0.75, 0.36, 0.36, 0.36]
    for each in (found[:8], found[8:]):
        assert [loop.bias for loop in each] == pytest.approx(places, abs=0.03)
        assert [loop.amplitude for loop in each] == pytest.approx(sizes, rel=0.02)
    assert found[0].frequency_hz < found[8].frequency_hz
    before = [segment for segment in run.segments if segment.kind == "hold"]
    assert len(before) == len(found)


LOOP = LoopMetrics("x", 1.0, 0.0, 5.0, -5.0, 5.0, 10.0, 0.0, np.zeros(4), np.zeros(4))


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
