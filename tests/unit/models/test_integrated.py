"""Plays and deadbands in one: the integrated model and its inverse cancel (chapter 6)."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from hilctl.base.errors import ModelError
from hilctl.kernels.hysteresis import play_sum_shared, rest_memory
from hilctl.models.integrated import DeadbandFunction, IntegratedModel, exponential_integrated
from hilctl.models.literature.butterfly import ButterflyModel
from hilctl.models.plays import inverse_plays
from tests.published import terfenol_rdpi
from tests.unit.models.test_plays import DEADBAND, GOOD, broken


@pytest.mark.parametrize(("change", "message"), [
    ({"slope": 0.0}, "g_0 = 0.0"),
    ({"slope": -1.0}, "g_0 = -1.0"),
    ({"up_weights": (-2.0, 0.5)}, "g_0 + ... + g_1 = 0.0"),
    ({"up_weights": (-0.5, -1.75)}, "g_0 + ... + g_2 = -0.25"),
    ({"down_weights": (-2.5, 1.0)}, "g_0 + ... + g_-1 = -0.5"),
    ({"down_weights": (1.0, -4.0)}, "g_0 + ... + g_-2 = -1.0"),
    ({"up_thresholds": (0.0, 2.0)}, "d must rise from 0 (the thresholds must dilate): d_1 = 0.0"),
    ({"up_thresholds": (1.0, 1.0)}, "d_2 = 1.0 after 1.0"),
    ({"down_thresholds": (1.0, -3.0)}, "d_- must fall from 0"),
    ({"down_thresholds": (-3.0, -1.0)}, "d_-_2 = -1.0 after -3.0"),
    ({"up_weights": (1.0,)}, "up_weights must have one value per threshold: 1 for 2"),
    ({"down_weights": (1.0,)}, "down_weights must have one value per threshold: 1 for 2"),
])  # fmt: skip
def test_each_condition_of_the_deadbands_is_named(change, message):
    assert message in broken(DeadbandFunction, **{**DEADBAND, **change})


@pytest.mark.parametrize(("parameters", "message"), [
    ({"slope": 5e-324}, "finite number"),
    ({"slope": 1.0, "up_thresholds": (1.0, 1.0000000000000002),
      "up_weights": (-0.9999999999999999, 1.0)}, "d_2 = 1.0 after 1.0"),
    ({"slope": 1e-300, "down_thresholds": (-1.0,), "down_weights": (1e300,)}, "g_-1 = 0.0"),
])  # fmt: skip
def test_deadbands_that_rounding_takes_apart_have_no_inverse(parameters, message):
    model = IntegratedModel(**GOOD, deadband=DeadbandFunction(**parameters))
    with pytest.raises(ModelError, match=message):
        model.inverse(1_000.0)


SAMPLE_RATE_HZ = 50_000.0
FREQUENCIES_HZ = [1.0, 10.0, 50.0, 100.0, 200.0, 250.0]


@pytest.fixture
def omega():
    """An integrated model of the published form, 12 plays and 17 deadbands, gamma > 0."""
    return exponential_integrated(
        alpha=0.3, gamma_s=2e-4, a_0=1.0, alpha_0=0.2, beta_0=0.3, g_0=6.0,
        alpha_1=0.3, beta_1=0.1, d_p=0.8, alpha_2=0.4, beta_2=0.1, d_n=0.8,
    )  # fmt: skip


def sine(amplitude, frequency_hz, cycles=3):
    n = round(cycles * SAMPLE_RATE_HZ / frequency_hz)
    return amplitude * np.sin(2 * np.pi * frequency_hz * np.arange(n) / SAMPLE_RATE_HZ)


def shared(v, widening, direct, weights, thresholds):
    out = np.empty_like(v)
    play_sum_shared(v, widening, direct, thresholds, weights, rest_memory(weights.size), out)
    return out


def widening_of(model, v):
    return model.threshold_growth_s * np.abs(np.diff(v, prepend=v[0])) * SAMPLE_RATE_HZ


@pytest.mark.parametrize("frequency_hz", FREQUENCIES_HZ)
def test_integrated_and_its_inverse_cancel_with_shared_thresholds(omega, frequency_hz):
    """Lambda, Pi, Pi^-1 and Lambda^-1 in a row return the input to 1e-12, both ways."""
    weights, thresholds = np.array(omega.weights), np.array(omega.thresholds)
    inverse, unbend = omega.inverse_parameters(), omega.deadband.inverse()
    v = sine(5.0, frequency_hz) + sine(1.0, 2 * frequency_hz, cycles=6)
    growth = widening_of(omega, v)
    y = omega.deadband(shared(v, growth, omega.direct, weights, thresholds))
    back = shared(unbend(y), omega.direct * growth, *inverse)
    assert np.max(np.abs(back - v)) <= 1e-12 * np.max(np.abs(v))
    command = shared(unbend(y), omega.direct * growth, *inverse)
    again = omega.deadband(shared(command, growth, omega.direct, weights, thresholds))
    assert np.max(np.abs(again - y)) <= 1e-12 * np.max(np.abs(y))


def test_with_rate_the_inverse_leaves_little():
    """With the published n = 4 set what remains grows with the rate: the actuator has its own."""
    model = terfenol_rdpi()
    remaining = []
    for frequency_hz in (1.0, 100.0, 200.0):
        y = sine(13.0, frequency_hz)
        command = model.inverse(SAMPLE_RATE_HZ).process(y)
        back = model.forward(SAMPLE_RATE_HZ).process(command)
        n = round(SAMPLE_RATE_HZ / frequency_hz)
        remaining.append(np.max(np.abs(back - y)[-n:]) / np.ptp(y) * 100.0)
    assert remaining[0] < 0.1 < remaining[1] < remaining[2] < 10.0


def peak_hysteresis_percent(v, y, frequency_hz):
    """H_P / M_P over the last cycle: widest gap between the branches over the stroke."""
    n = round(SAMPLE_RATE_HZ / frequency_hz)
    start = np.argmax(v[-n:])
    v, y = np.roll(v[-n:], -start), np.roll(y[-n:], -start)
    falling, rising = slice(0, n // 2), slice(n // 2, n)
    grid = np.linspace(v.min(), v.max(), 2_001)[1:-1]
    descending = np.interp(grid, v[falling][::-1], y[falling][::-1])
    ascending = np.interp(grid, v[rising], y[rising])
    return 100.0 * np.max(descending - ascending) / np.ptp(y)


@pytest.mark.parametrize(("frequency_hz", "percent"), [(1.0, 18.0), (100.0, 26.6), (200.0, 34.3)])
def test_rdpi_peak_hysteresis(frequency_hz, percent):
    """The n = 4 model at 2.3 A has 18 % at 1 Hz and grows with the frequency as published."""
    v = sine(2.3, frequency_hz)
    y = terfenol_rdpi().forward(SAMPLE_RATE_HZ).process(v)
    assert peak_hysteresis_percent(v, y, frequency_hz) == pytest.approx(percent, abs=0.3)


def test_inverse_plays_follow_the_published_relations():
    """Rising by (a_0 + ... + a_i)(r_{i+1} - r_i) from a_0 r_1; reciprocal slopes (5.8-5.10)."""
    a, r = [1.2, 0.3, 0.0, 0.7, 0.2], [0.4, 0.9, 1.0, 2.5]
    direct, weights, thresholds = inverse_plays(a[0], np.array(a[1:]), np.array(r))
    expected = [a[0] * r[0]]
    for i in range(1, 4):
        expected.append(expected[-1] + sum(a[: i + 1]) * (r[i] - r[i - 1]))
    assert direct == 1.0 / a[0]
    np.testing.assert_allclose(thresholds, expected, rtol=1e-14)
    relations = [1.0 / sum(a[: i + 1]) - 1.0 / sum(a[:i]) for i in range(1, 5)]
    np.testing.assert_allclose(weights, relations, rtol=1e-14, atol=1e-16)


def test_inverse_deadbands_follow_the_published_relations(omega):
    """Thresholds Lambda(d_j), weights -g_j / (S_j S_{j-1}), both sides (6.13-6.16)."""
    function, inverse = omega.deadband, omega.deadband.inverse()
    assert inverse.slope == 1.0 / function.slope
    for d, g, dh, gh in (
        (function.up_thresholds, function.up_weights, inverse.up_thresholds, inverse.up_weights),
        (function.down_thresholds, function.down_weights,
         inverse.down_thresholds, inverse.down_weights),
    ):  # fmt: skip
        slope = function.slope
        for j in range(8):
            corner = function.slope * d[j] + sum(g[i] * (d[j] - d[i]) for i in range(j))
            assert dh[j] == pytest.approx(corner, rel=1e-14)
            assert gh[j] == pytest.approx(-g[j] / ((slope + g[j]) * slope), rel=1e-11)
            slope += g[j]


def test_exponential_parameters_are_the_published_ones(omega):
    assert omega.operators == 12
    np.testing.assert_allclose(omega.thresholds, 0.3 * np.arange(1, 13))
    np.testing.assert_allclose(omega.weights, 0.2 * np.exp(-0.3 * np.arange(1, 13)))
    deadband = omega.deadband
    assert isinstance(deadband, DeadbandFunction)
    np.testing.assert_allclose(deadband.up_thresholds, 0.8 * np.arange(1, 9))
    np.testing.assert_allclose(deadband.up_weights, -0.3 * np.exp(-0.1 * np.arange(1, 9)))
    np.testing.assert_allclose(deadband.down_thresholds, -0.8 * np.arange(1, 9))
    np.testing.assert_allclose(deadband.down_weights, 0.4 * np.exp(-0.1 * np.arange(1, 9)))


RATE_HZ = 10_000.0
SHAPE = DeadbandFunction(slope=0.3, up_thresholds=(2.0, 4.0, 9.0), up_weights=(0.7, 1.2, -1.5))


def butterfly(**changes):
    parameters = {
        "direct": 1.0,
        "weights": (0.4, 0.2, 0.1),
        "thresholds": (0.3, 0.6, 1.2),
        "output_range_um": (0.0, 20.0),
        "shape": SHAPE,
    }
    return ButterflyModel(**parameters | changes)


def tone(samples=2000, amplitude=6.0, offset=0.0):
    start = np.minimum(np.arange(samples) / 500.0, 1.0)
    return start * (offset + amplitude * np.sin(2.0 * np.pi * np.arange(samples) / 500.0))


def test_without_bias_displacement_is_even():
    model = butterfly()
    up = model.forward(RATE_HZ).process(tone())
    down = model.forward(RATE_HZ).process(-tone())
    np.testing.assert_array_equal(up, down)
    assert up.min() >= 0.0
    assert up[500:].max() > 8.0


@pytest.mark.parametrize(
    ("bias", "input_range", "wing"),
    [(0.0, None, 1.0), (0.0, (-6.0, 0.0), -1.0), (8.0, None, 1.0), (-8.0, (-2.0, 6.0), -1.0)],
)
def test_the_inverse_undoes_the_model_on_its_wing(bias, input_range, wing):
    rest_um = float(SHAPE(np.array([abs(bias)]))[0])
    model = butterfly(
        bias=bias,
        input_range=input_range,
        output_offset_um=-rest_um,
        output_range_um=(-rest_um, 20.0),
    )
    wanted_um = rest_um * -0.5 + tone(amplitude=0.4 * rest_um + 1.0, offset=0.6 * rest_um + 1.2)
    wanted_um = np.maximum(wanted_um, -rest_um)
    command = model.inverse(RATE_HZ).process(wanted_um)
    got_um = model.forward(RATE_HZ).process(command)
    np.testing.assert_allclose(got_um, wanted_um, atol=1e-9)
    assert model.wing == wing
    if bias == 0.0:
        assert (command[1:] * wing >= 0.0).all()


@pytest.mark.parametrize("output_range_um", [None, (-0.1, 20.0)])
def test_both_wings_at_once_are_refused(output_range_um):
    with pytest.raises(ModelError, match="output_range_um must begin"):
        butterfly(output_range_um=output_range_um).inverse(RATE_HZ)


def test_what_no_command_reaches_gets_the_turning_point():
    inverse = butterfly().inverse(RATE_HZ)
    command = inverse.process(np.array([3.0, 1.0, -5.0, -50.0, -5.0, 0.0]))
    assert np.isfinite(command).all()
    assert command[2] == command[3] == command[4] == command[5]


def test_an_odd_shape_is_refused():
    with pytest.raises(ValidationError, match="even"):
        butterfly(shape=DeadbandFunction(down_thresholds=(-1.0,), down_weights=(0.2,)))


def test_falling_shape_is_refused():
    with pytest.raises(ValidationError, match="cumulative deadband slope"):
        butterfly(shape={"slope": 1.0, "up_thresholds": (1.0,), "up_weights": (-1.0,)})


@given(
    signal=st.lists(st.floats(-1e3, 1e3), min_size=1, max_size=60),
    cut=st.integers(0, 60),
    gamma_s=st.floats(0.0, 1e-3),
    direction=st.sampled_from(["forward", "inverse"]),
)
def test_cuts_make_no_difference_and_nothing_blows_up(signal, cut, gamma_s, direction):
    model = butterfly(gamma_s=gamma_s, bias=-3.0, output_range_um=(0.0, 20.0))
    values = np.array(signal)
    whole = getattr(model, direction)(RATE_HZ).process(values)
    operator = getattr(model, direction)(RATE_HZ)
    parts = [operator.process(values[:cut].copy()), operator.process(values[cut:].copy())]
    np.testing.assert_array_equal(np.concatenate(parts), whole)
    assert np.isfinite(whole).all()
