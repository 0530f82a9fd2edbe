"""Jiles and Atherton's rods against their own equations, and what is known of them."""

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

from hilctl_drivers.simulated.actuator_base import Coil
from tests.rigs.jiles_atherton import (
    GrowingLagParameters,
    JilesAthertonParameters,
    langevin,
    susceptibility,
)

RATED = JilesAthertonParameters()
GROWING = GrowingLagParameters()
STEP_S = 1e-5


def langevin_by_formula(x):
    return 1.0 / math.tanh(x) - 1.0 / x if abs(x) > 1e-3 else x / 3.0


def anhysteretic(field, rods=RATED):
    """M of L((H + alpha' M) / a) by bisection."""
    saturation, shape = rods.saturation_a_per_m, rods.shape_a_per_m

    def excess(magnetisation):
        inner = (field + rods.effective_coupling * magnetisation) / shape
        return magnetisation - saturation * langevin_by_formula(inner)

    return float(brentq(excess, -saturation, saturation, xtol=1e-6))


@pytest.mark.parametrize("x", [-300.0, -0.5, -0.051, -0.049, 1e-4, 0.05, 3.0, 500.0])
def test_langevin(x):
    """The function is its formula and the slope its difference quotient, series and all."""
    value, slope = langevin(x)
    assert value == pytest.approx(langevin_by_formula(x), rel=1e-8)
    quotient = (langevin(x + 1e-4)[0] - langevin(x - 1e-4)[0]) / 2e-4
    assert slope == pytest.approx(quotient, abs=1e-8)


def test_coupling_has_the_stress_in_it():
    """Compression works against the field: alpha' is negative, and the anhysteretic sheared."""
    stress = 9.0 * 1.005e-3 * -22e6 / (2.0 * 4e-7 * math.pi * 7.65e5**2)
    assert RATED.effective_coupling == pytest.approx(0.045 + stress, rel=1e-6)
    assert anhysteretic(20e3) < anhysteretic(20e3, replace(RATED, stress_pa=0.0))


@pytest.mark.parametrize("bias", [0.0, 13e3, 44.1e3, 90e3, 1e7])
def test_rests_on_the_anhysteretic(bias):
    """Which at high fields is saturation."""
    model = RATED.rods(Coil(1.0, bias, STEP_S))
    rest_um = model.rest()
    assert model.state[1] == pytest.approx(anhysteretic(bias), abs=1.0)
    full_um = 1.5 * 1.005e-3 * 0.1206e6
    assert rest_um == pytest.approx(full_um * (anhysteretic(bias) / 7.65e5) ** 2, rel=1e-5)
    if bias == 1e7:
        assert rest_um == pytest.approx(full_um, rel=0.01)


def test_susceptibility_is_never_negative():
    """Wherever M stands, a field that grows does not make it fall: the one guard there is."""
    material = RATED.material
    for field in np.linspace(-90e3, 90e3, 19):
        for start in np.linspace(-7e5, 7e5, 15):
            assert susceptibility(field, start, 1.0, material) > 0.0
            assert susceptibility(field, start, -1.0, material) > 0.0


def test_losses_are_the_published_ones():
    """Where M ramps steadily, the field is behind by e dM/dt + x (dM/dt)^(1/2)."""
    rate = 3e8
    eddy, wall, _ = RATED.losses
    assert eddy == pytest.approx(4e-7 * math.pi * 6.15e-3**2 / (8.0 * 0.6e-6), rel=1e-6)
    assert (wall * math.sqrt(rate)) ** 2 == pytest.approx(
        0.1356 * 100.0 * math.pi * 6.15e-3**2 / 0.6e-6 * 4e-7 * math.pi * rate, rel=1e-6
    )
    field = 20e3 + 5e7 * STEP_S * np.arange(60)
    model = RATED.rods(Coil(1.0, 0.0, STEP_S))
    model.rest()
    model.state[:] = field[0], anhysteretic(20e3)
    for k in range(59):
        before = model.state.copy()
        ends = np.array([field[k], 0.5 * (field[k] + field[k + 1]), field[k + 1]])
        model.follow(ends, np.empty(1))
    pace = (model.state[1] - before[1]) / STEP_S
    behind = 0.5 * (field[58] + field[59]) - 0.5 * (model.state[0] + before[0])
    assert behind == pytest.approx(eddy * pace + wall * math.sqrt(pace), rel=1e-6)


@pytest.mark.parametrize("rods", [RATED, GROWING])
@pytest.mark.parametrize("frequency_hz", [100.0, 250.0])
def test_is_its_differential_equation(rods, frequency_hz):
    """Another solver of the published equations, written down anew, agrees within 0.2 %."""
    loss, wall, growth = rods.losses
    saturation, shape, c = 7.65e5, 7012.0, 0.18
    alpha = rods.effective_coupling

    def applied(time_s):
        return 44.1e3 + 5.09e3 * 6.0 * math.sin(2.0 * math.pi * frequency_hz * time_s)

    def rates(time_s, state):
        field, magnetised = state
        behind = applied(time_s) - field
        if behind == 0.0:
            return [0.0, 0.0]
        delta = math.copysign(1.0, behind)
        eddy = loss * (1.0 + growth * abs(behind))
        root = (math.sqrt(wall**2 + 4.0 * eddy * abs(behind)) - wall) / (2.0 * eddy)
        pace = delta * root**2  # dM/dt from the loss equation
        inner = (field + alpha * magnetised) / shape
        curve = saturation * langevin_by_formula(inner)
        slope = saturation / shape * (1.0 / inner**2 - 1.0 / math.sinh(inner) ** 2)
        distance = (curve - magnetised) / (1.0 - c)
        drag = delta * rods.pinning_a_per_m - alpha * distance
        irreversible = distance / drag if distance * delta > 0.0 else 0.0
        chi = ((1.0 - c) * irreversible + c * slope) / (1.0 - alpha * c * slope)
        return [pace / chi, pace]

    duration_s = 1.5 / frequency_hz
    start = [44.1e3, anhysteretic(44.1e3)]
    times = STEP_S * np.arange(1, round(duration_s / STEP_S) + 1)
    solved = solve_ivp(
        rates, (0.0, times[-1]), start, t_eval=times, rtol=1e-7, atol=1e-3, max_step=STEP_S
    )
    model = rods.rods(Coil(5.09e3, 44.1e3, STEP_S))
    model.rest()
    found = np.empty(times.size)
    for k in range(times.size):
        halves = STEP_S * (k + np.array([0.0, 0.5, 1.0]))
        model.follow(6.0 * np.sin(2.0 * np.pi * frequency_hz * halves), np.empty(1))
        found[k] = model.state[1]
    assert np.abs(found - solved.y[1]).max() < 0.002 * np.ptp(solved.y[1])
