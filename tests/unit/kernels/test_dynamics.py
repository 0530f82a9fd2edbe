"""Lag, structure and delay: against independent solvers, bit for bit, block by block, in place."""

import math

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.linalg import expm
from scipy.signal import StateSpace, cont2discrete, lfilter, lsim

from hilctl.kernels import dynamics
from hilctl.kernels.dynamics import (
    creep_block,
    exponential,
    mode_block,
    uncreep_block,
    unmode_block,
)
from hilctl.kernels.hysteresis import rest_memory
from hilctl.models.linear_stages import Compliance, FirstMode, FurtherMode, smoothing_weights

RATE_HZ = 20_000.0
SIGNAL = 2.0 * np.sin(np.arange(400) / 9.0) + 0.6 * np.cos(np.arange(400) / 2.3)
STRUCTURE = FirstMode(natural_hz=1500.0, damping_ratio=0.1).forward(RATE_HZ).parameters[0]
COMPLIANCE = Compliance(lowest_um=-1.5, cell_um=1.0, relative=(1.6, 1.2, 1.0, 0.7))
BY_PLACE = FirstMode(natural_hz=1500.0, damping_ratio=0.1, compliance=COMPLIANCE)
LEFT, GAIN = np.array([0.5, 0.9, 0.999]), np.array([0.02, 0.004, 3e-5])
PARAMETERS = np.concatenate((LEFT, GAIN))
PAIR = FurtherMode(
    natural_hz=900.0, damping_ratio=0.04, antiresonance_hz=760.0, antiresonance_damping_ratio=0.02
)
MODE_PARAMETERS = PAIR._parameters(RATE_HZ)
STREAMING = {
    "lag": (dynamics.lag_block, (0.3, 0.4), 1),
    "linear lag": (dynamics.lag_block, (0.3, 0.0), 1),
    "lead": (dynamics.lead_block, (0.3, 0.4), 1),
    "linear lead": (dynamics.lead_block, (0.3, 0.0), 1),
    "structure": (mode_block, (STRUCTURE,), 2),
    "structure by place": (dynamics.place_mode_block, BY_PLACE.forward(RATE_HZ).parameters, 2),
    "inverse by place": (dynamics.place_unmode_block, (0.4, 4.0, *COMPLIANCE.table), 2),
    "weigh": (dynamics.weigh_block, (smoothing_weights(1.5, 0.3, 5.0)[0],), 10),
    "delay": (dynamics.delay_block, (), 4),
    "between": (dynamics.between_block, (0.3,), 0),
    "mode": (mode_block, (MODE_PARAMETERS,), 2),
    "inverse mode": (unmode_block, (MODE_PARAMETERS,), 2),
    "creep": (creep_block, (PARAMETERS,), 3),
    "inverse creep": (uncreep_block, (PARAMETERS,), 3),
    "bend": (dynamics.bend_block, (0.2, 0.1), 0),
    "inverse bend": (dynamics.unbend_block, (0.2, 0.1), 0),
}


def stream(name, signal, memory=None, *, plain=False, out=None):
    kernel, parameters, size = STREAMING[name]
    memory = rest_memory(size) if memory is None else memory
    out = np.empty_like(signal) if out is None else out
    (kernel.py_func if plain else kernel)(signal, *parameters, memory, out)
    return out, memory


@pytest.mark.parametrize("name", STREAMING)
def test_compiled_and_python_agree_bit_for_bit(name):
    out, memory = stream(name, SIGNAL)
    plain, plain_memory = stream(name, SIGNAL, plain=True)
    np.testing.assert_array_equal(out, plain)
    np.testing.assert_array_equal(memory, plain_memory)


@pytest.mark.parametrize("name", STREAMING)
def test_any_cut_and_the_input_itself_as_output(name):
    whole, end = stream(name, SIGNAL)
    memory = None
    parts = []
    for part in np.split(SIGNAL.copy(), [1, 2, 9, 10, 250]):
        out, memory = stream(name, part, memory, out=part)
        parts.append(out)
    np.testing.assert_array_equal(np.concatenate(parts), whole)
    np.testing.assert_array_equal(memory, end)


@pytest.mark.parametrize(
    "name", [name for name in STREAMING if "creep" not in name and "bend" not in name]
)
def test_a_constant_passes_from_the_first_sample(name):
    out, _ = stream(name, np.full(50, -3.7))
    np.testing.assert_allclose(out, -3.7, rtol=1e-14)


@pytest.mark.parametrize(("periods", "growth"), [(0.2, 0.0), (0.2, 0.3), (3.0, 2.0), (0.01, 50.0)])
def test_lag_solves_its_equation(periods, growth):
    v = np.array([0.0, 1.0, 1.0, -2.0, 0.5, 0.5, 4.0, 0.0])
    out = np.empty_like(v)
    dynamics.lag_block(v, periods, growth, rest_memory(1), out)
    x = 0.0
    for k in range(1, v.size):
        solved = solve_ivp(
            lambda t, y, held=v[k - 1]: (held - y) / (1.0 + growth * abs(held - y)),
            (0.0, periods), [x], rtol=1e-10, atol=1e-12,
        )  # fmt: skip
        x = solved.y[0, -1]
        assert out[k] == pytest.approx(x, abs=1e-8)


@pytest.mark.parametrize("periods", [1e-9, 0.2, 30.0, 1e4, 1e300])
@pytest.mark.parametrize("growth", [0.0, 1e-300, 1e-9, 0.3, 1e3, 1e9])
@pytest.mark.parametrize("behind", [5e-324, 1e-9, 1.0, 1e9])
def test_lag_is_never_past_its_command(periods, growth, behind):
    out = np.empty(4)
    dynamics.lag_block(np.array([0.0, *[behind] * 3]), periods, growth, rest_memory(1), out)
    assert np.all(np.diff(out) >= 0.0)
    assert np.all((out >= 0.0) & (out <= behind))


def test_lead_brings_the_lag_to_wanted_values():
    wanted = 2.0 * np.sin(np.arange(400) / 30.0)
    command, out = np.empty(400), np.empty(400)
    dynamics.lead_block(wanted, 0.2, 0.4, rest_memory(1), command)
    dynamics.lag_block(command, 0.2, 0.4, rest_memory(1), out)
    np.testing.assert_allclose(out[1:], wanted[:-1], atol=1e-13)
    assert np.abs(command).max() > np.abs(wanted).max()


def test_lead_of_a_jump_stays_below_the_lag_s_limit_and_catches_up():
    """A jump no lag could follow is followed as fast as 0.8 of its limit, and then held."""
    wanted = np.where(np.arange(80) < 5, 0.0, 6.0)
    command, out = np.empty(80), np.empty(80)
    dynamics.lead_block(wanted, 0.2, 0.4, rest_memory(1), command)
    dynamics.lag_block(command, 0.2, 0.4, rest_memory(1), out)
    step = 0.8 * 0.2 / 0.4
    assert np.diff(out).max() == pytest.approx(step)
    np.testing.assert_allclose(out[25:], 6.0, atol=1e-12)
    assert command.max() <= 6.0 + step / -math.expm1(0.4 * step - 0.2)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("growth", [0.0, 0.4])
def test_lead_shows_what_is_not_a_number_and_goes_on(bad, growth):
    wanted = np.array([1.0, 1.1, bad, 1.2, 1.3])
    command = np.empty(5)
    dynamics.lead_block(wanted, 0.2, growth, rest_memory(1), command)
    assert np.isfinite(command).tolist() == [True, True, False, True, True]


def test_structure_is_the_exact_solution():
    omega = 2.0 * math.pi * 1500.0
    system = StateSpace([[0.0, 1.0], [-(omega**2), -0.2 * omega]], [[0.0], [omega**2]],
                        [[1.0, 0.0]], [[0.0]])  # fmt: skip
    signal = SIGNAL - SIGNAL[0]
    _, expected, _ = lsim(system, signal, np.arange(signal.size) / RATE_HZ)
    out = np.empty_like(signal)
    mode_block(signal, STRUCTURE, rest_memory(2), out)
    np.testing.assert_allclose(out, expected, atol=1e-9)


@pytest.mark.parametrize("samples", [1, 2, 4])
def test_delay_holds_back_whole_samples(samples):
    ramp, out = np.arange(20.0), np.empty(20)
    dynamics.delay_block(ramp, rest_memory(samples), out)
    assert out.tolist() == [0.0] * samples + ramp[:-samples].tolist()


def test_between_holds_back_a_part_of_a_sample():
    ramp = np.arange(20.0)
    between, _ = stream("between", ramp)
    np.testing.assert_allclose(between[1:], ramp[1:] - 0.7)


def test_the_first_weight_is_of_the_oldest_value():
    weights, out = np.array([0.5, 2.0, -1.0]), np.empty(9)
    dynamics.weigh_block(SIGNAL[:9], weights, rest_memory(2), out)
    before = np.concatenate([SIGNAL[:1], SIGNAL[:1], SIGNAL[:9]])
    np.testing.assert_allclose(out, np.convolve(before, weights[::-1], "valid"), rtol=1e-13)


def run(kernel, values, memory=None, parameters=PARAMETERS):
    memory = rest_memory(3 if parameters is PARAMETERS else 2) if memory is None else memory
    out = np.empty_like(values)
    kernel(values, parameters, memory, out)
    return out, memory


@pytest.fixture
def walk():
    return np.cumsum(np.random.default_rng(7).standard_normal(3000))


def test_creep_is_a_sum_of_first_order_filters_a_sample_late(walk):
    crept = sum(lfilter([0.0, g], [1.0, -a], walk) for a, g in zip(LEFT, GAIN, strict=True))
    out, memory = run(creep_block, walk)
    np.testing.assert_allclose(out, walk + crept, rtol=0.0, atol=1e-10)
    assert memory[-1] == walk[-1]


def test_undone_to_rounding_from_any_memory(walk):
    memory = np.array([0.3, -0.2, 0.1, 4.0])
    y, _ = run(creep_block, walk, memory.copy())
    x, left = run(uncreep_block, y, memory.copy())
    np.testing.assert_allclose(x, walk, rtol=0.0, atol=1e-10)
    assert left[-1] == x[-1]


@pytest.mark.parametrize("kernel", [creep_block, uncreep_block])
@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_what_is_no_displacement_creeps_nowhere(walk, kernel, bad):
    values = walk.copy()
    values[100] = bad
    out, _ = run(kernel, values)
    assert not np.isfinite(out[100])
    assert np.isfinite(np.delete(out, 100)).all()


@pytest.mark.parametrize("bend", [0.2, -0.2, 1e-12])
def test_a_bend_rises_everywhere_and_is_undone_to_rounding(bend):
    p, memory = np.linspace(-30.0, 30.0, 6001), rest_memory(0)
    y, back = np.empty_like(p), np.empty_like(p)
    dynamics.bend_block(p, bend, 0.1, memory, y)
    dynamics.unbend_block(y, bend, 0.1, memory, back)
    assert np.diff(y).min() > 0.099 * 0.01
    np.testing.assert_allclose(back, p, rtol=1e-10, atol=1e-10)


def test_a_pair_is_what_scipy_makes_of_its_transfer_function(walk):
    up, down = 1.0 / (2.0 * np.pi * 760.0), 1.0 / (2.0 * np.pi * 900.0)
    transfer = [up**2, 2.0 * 0.02 * up, 1.0], [down**2, 2.0 * 0.04 * down, 1.0]
    numerator, denominator, _ = cont2discrete(transfer, 1.0 / RATE_HZ, method="foh")
    wanted = lfilter(numerator[0], denominator, walk - walk[0]) + walk[0]
    out, memory = run(mode_block, walk, parameters=MODE_PARAMETERS)
    np.testing.assert_allclose(out, wanted, rtol=0.0, atol=1e-8)
    assert memory[2] == walk[-1]


def test_a_mode_is_undone_to_rounding_from_any_memory(walk):
    memory = np.array([0.3, -0.2, 4.0])
    y, _ = run(mode_block, walk, memory.copy(), MODE_PARAMETERS)
    x, left = run(unmode_block, y, memory.copy(), MODE_PARAMETERS)
    np.testing.assert_allclose(x, walk, rtol=0.0, atol=1e-9)
    assert left[2] == x[-1]


@pytest.mark.parametrize("kernel", [mode_block, unmode_block])
@pytest.mark.parametrize("before", [0.0, 5.0])
def test_it_begins_at_rest_whatever_was_before(kernel, before):
    memory = np.array([before / 5.0, before, np.nan])
    out, _ = run(kernel, np.full(50, 3.25), memory, MODE_PARAMETERS)
    np.testing.assert_allclose(out, 3.25, rtol=1e-13)


@pytest.mark.parametrize("kernel", [mode_block, unmode_block])
@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_what_is_no_displacement_is_forgotten(walk, kernel, bad):
    values = walk.copy()
    values[100] = bad
    with np.errstate(invalid="ignore"):  # of Python, where it is not compiled
        out, _ = run(kernel, values, parameters=MODE_PARAMETERS)
    assert not np.isfinite(out[100])
    assert np.isfinite(out[103:]).all()


@pytest.mark.parametrize("size", [1, 3, 6])
@pytest.mark.parametrize("scale", [1e-9, 0.1, 1.0, 30.0])
def test_it_is_scipy_s(size, scale):
    rng = np.random.default_rng(size)
    matrix = scale * (rng.standard_normal((size, size)) - np.eye(size))
    wanted = expm(matrix)
    np.testing.assert_allclose(
        exponential(matrix), wanted, rtol=0.0, atol=1e-12 * np.abs(wanted).max()
    )


def test_nothing_is_one_and_a_turn_turns():
    np.testing.assert_array_equal(exponential(np.zeros((2, 2))), np.eye(2))
    turned = exponential(np.array([[0.0, -1.0], [1.0, 0.0]]) * math.pi / 3.0)
    half, side = 0.5, math.sqrt(0.75)
    np.testing.assert_allclose(turned, [[half, -side], [side, half]], rtol=1e-14)


@pytest.mark.parametrize(("place", "cell", "part"), [
    (-9.0, 0, 0.0), (-1.5, 0, 0.0), (-1.0, 0, 0.5), (0.5, 2, 0.0), (1.25, 2, 0.75), (1.5, 2, 1.0),
    (9.0, 2, 1.0), (math.nan, 0, 0.0),
])  # fmt: skip
def test_a_table_is_constant_beyond_its_ends(place, cell, part):
    assert dynamics.cell_of(place, -1.5, 1.0, 3) == pytest.approx((cell, part))
    assert dynamics.cell_of.py_func(place, -1.5, 1.0, 3) == pytest.approx((cell, part))


def test_a_structure_by_place_is_the_solution_of_its_equation():
    """c(y) (y'' / w^2 + 2 zeta y' / w) + y = x; c follows the position a sample late."""
    rate_hz, omega = 10.0 * RATE_HZ, 2.0 * np.pi * 1500.0
    t = np.arange(4000) / rate_hz
    x = 2.0 * np.sin(t * RATE_HZ / 9.0) + 0.6 * np.cos(t * RATE_HZ / 2.3)

    def rates(time, state):
        y, velocity = state
        softer = np.interp(y, [-1.5, -0.5, 0.5, 1.5], COMPLIANCE.relative)
        pull = (np.interp(time, t, x) - y) / softer
        return velocity, omega**2 * pull - 2.0 * 0.1 * omega * velocity

    ends = 0.0, t[-1]
    solved = solve_ivp(rates, ends, (x[0], 0.0), t_eval=t, max_step=1e-5, rtol=1e-8, atol=1e-8)
    out = BY_PLACE.forward(rate_hz).process(x)
    np.testing.assert_allclose(out, solved.y[0], atol=0.01 * np.ptp(x))
    plain = BY_PLACE.model_copy(update={"compliance": None}).forward(rate_hz).process(x)
    assert np.abs(plain - solved.y[0]).max() > 0.1 * np.ptp(x)
