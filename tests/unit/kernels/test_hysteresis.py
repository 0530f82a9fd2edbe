"""Each operator against its published equation, written out here in plain Python."""

import numpy as np
import pytest

from hilctl.kernels import hysteresis

THRESHOLDS = np.array([0.2, 0.5, 0.9, 1.6])
WEIGHTS = np.array([0.7, 0.1, 0.4, 0.3])
DIRECT = 1.3
GROWTH_S = 2e-4
RATE_HZ = 5_000.0
D_UP, G_UP = np.array([0.4, 1.1, 1.9]), np.array([-0.2, -0.3, 0.1])
D_DOWN, G_DOWN = np.array([-0.3, -1.4]), np.array([0.25, -0.4])
SLOPE = 1.7
PLAYS = (GROWTH_S * RATE_HZ, DIRECT, THRESHOLDS, WEIGHTS)
DEADBANDS = (SLOPE, D_UP, G_UP, D_DOWN, G_DOWN)


@pytest.fixture
def signal():
    """Major and minor loops of both signs that start away from 0: float64[600]."""
    t = np.arange(600) / RATE_HZ
    return 1.9 * np.cos(2 * np.pi * 40 * t) + 0.8 * np.sin(2 * np.pi * 210 * t)


def play(v, thresholds):
    """F(t_j) = max{v_j - r_j, min{v_j + r_j, F(t_{j-1})}}, started from 0."""
    held, out = 0.0, []
    for now, r in zip(v.tolist(), thresholds, strict=True):
        held = max(now - r, min(now + r, held))
        out.append(held)
    return np.array(out)


def stop(v, s):
    """E(t_j) = min{s, max{-s, v_j - v_{j-1} + E(t_{j-1})}}, from an input at rest."""
    held, before, out = 0.0, 0.0, []
    for now in v.tolist():
        held = min(s, max(-s, now - before + held))
        before = now
        out.append(held)
    return np.array(out)


def widenings(v):
    """What the rate adds, gamma |v'|, for each sample; the first has no rate."""
    return GROWTH_S * np.abs(np.diff(v, prepend=v[0])) * RATE_HZ


def plays_weighed(v, growth):
    """a_0 v + sum a_i F_i[v], every threshold widened by ``growth`` (5.5)."""
    parts = [play(v, r + growth) for r in THRESHOLDS]
    return DIRECT * v + sum(a * part for a, part in zip(WEIGHTS, parts, strict=True))


def deadband(x, d):
    """J_d (6.6): the part of x beyond d, on the side of d; x itself for d = 0."""
    if d > 0:
        return max(x - d, 0.0)
    return min(x - d, 0.0) if d < 0 else x


def deadbands(x):
    """Sum g_i J_{d_i}(x) over both sides and the middle."""
    pairs = [(SLOPE, 0.0), *zip(G_UP, D_UP, strict=True), *zip(G_DOWN, D_DOWN, strict=True)]
    return sum(g * deadband(x, d) for g, d in pairs)


def close(actual, expected):
    np.testing.assert_allclose(actual, expected, rtol=0.0, atol=1e-13)


def run(kernel, v, *parameters, operators=THRESHOLDS.size):
    out, memory = np.empty_like(v), hysteresis.rest_memory(operators)
    kernel(v, *parameters, memory, out)
    return out


@pytest.mark.parametrize(
    ("v0", "start"), [(0.3, 0.0), (-0.3, 0.0), (1.5, 1.0), (-1.5, -1.0), (0.5, 0.0), (0.0, 0.0)]
)
def test_play_starts_as_published(v0, start):
    """From rest the first output is max{v0 - r, min{v0 + r, 0}}."""
    outputs = np.empty((1, 1))
    at_rest = hysteresis.rest_memory(1)
    hysteresis.play_outputs(np.array([v0]), np.zeros(1), np.array([0.5]), at_rest, outputs)
    assert outputs[0, 0] == start


def test_play_outputs_are_single_plays(signal):
    growth = widenings(signal)
    out = np.empty((signal.size, THRESHOLDS.size))
    hysteresis.play_outputs(signal, growth, THRESHOLDS, hysteresis.rest_memory(4), out)
    for column, r in zip(out.T, THRESHOLDS, strict=True):
        np.testing.assert_array_equal(column, play(signal, r + growth))


def test_stop_is_the_input_less_the_play(signal):
    held, before, out = 0.0, 0.0, []
    for now in signal:
        held = hysteresis.stop_step(now, before, 0.6, held)
        before = now
        out.append(held)
    close(out, stop(signal, 0.6))
    close(out, signal - play(signal, np.full(signal.size, 0.6)))


def test_stop_sum_follows_its_equation(signal):
    """w_0 v + sum w_i E_i[v] (3.11)."""
    expected = DIRECT * signal
    for w, s in zip(WEIGHTS, THRESHOLDS, strict=True):
        expected = expected + w * stop(signal, s)
    close(run(hysteresis.stop_sum, signal, DIRECT, THRESHOLDS, WEIGHTS), expected)


@pytest.mark.parametrize("rate_gain", [0.0, GROWTH_S * RATE_HZ])
def test_play_sum_widens_with_its_own_rate(signal, rate_gain):
    """Thresholds are r_i + gamma |v'|; gamma 0 is the rate-independent model (3.6, 5.5)."""
    growth = widenings(signal) if rate_gain else np.zeros(signal.size)
    out = run(hysteresis.play_sum, signal, (rate_gain, *PLAYS[1:]))
    close(out, plays_weighed(signal, growth))


def test_play_sum_shared_takes_the_widening_it_is_given(signal):
    growth = widenings(signal)
    shared = hysteresis.play_sum_shared
    own = run(shared, signal, growth, DIRECT, THRESHOLDS, WEIGHTS)
    close(own, run(hysteresis.play_sum, signal, PLAYS))
    other = run(shared, signal, growth[::-1].copy(), DIRECT, THRESHOLDS, WEIGHTS)
    close(other, plays_weighed(signal, growth[::-1]))


@pytest.mark.parametrize("x", [-5.0, -1.4, -1.0, -0.3, -0.1, -0.0, 0.0, 0.2, 0.4, 1.5, 1.9, 7.0])
def test_deadband_sum_follows_its_equation(x):
    """Lambda is the sum of the J_d of both signs (6.6), at its corners as well."""
    value = hysteresis.deadband_value(x, DEADBANDS)
    assert value == pytest.approx(deadbands(x), rel=1e-14, abs=1e-15)


@pytest.mark.parametrize(("d", "x", "expected"), [
    (0.5, 2.0, 1.5), (0.5, 0.5, 0.0), (0.5, -2.0, 0.0),
    (-0.5, -2.0, -1.5), (-0.5, -0.5, 0.0), (-0.5, 2.0, 0.0),
])  # fmt: skip
def test_one_deadband_lets_through_what_is_beyond_it(d, x, expected):
    none, one = np.empty(0), np.ones(1)
    up = (np.array([d]), one) if d > 0 else (none, none)
    down = (np.array([d]), one) if d < 0 else (none, none)
    assert hysteresis.deadband_value(x, (0.0, *up, *down)) == expected


def test_deadband_block_is_deadband_value(signal):
    out = np.empty_like(signal)
    hysteresis.deadband_block(signal, DEADBANDS, out)
    close(out, [deadbands(x) for x in signal])


def test_integrated_forward_is_plays_then_deadbands(signal):
    """Omega[v] = Lambda(Pi[v]) (6.5)."""
    out = run(hysteresis.integrated_forward, signal, PLAYS, DEADBANDS)
    close(out, [deadbands(x) for x in plays_weighed(signal, widenings(signal))])


def test_integrated_inverse_is_deadbands_then_plays(signal):
    """Omega^-1[y] = Pi^-1[Lambda^-1(y)] (6.17); the rate is that of Lambda^-1(y)."""
    out = run(hysteresis.integrated_inverse, signal, DEADBANDS, PLAYS)
    x = np.array([deadbands(y) for y in signal])
    close(out, plays_weighed(x, widenings(x)))


def test_no_operators_leave_the_direct_part(signal):
    out = run(hysteresis.play_sum, signal, (1.0, 2.0, np.empty(0), np.empty(0)), operators=0)
    np.testing.assert_array_equal(out, 2.0 * signal)
