"""Rods into which the field diffuses, against Bessel functions and another solver."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.special import jv

from hilctl_drivers.simulated.actuator_base import Coil
from tests.rigs import ROD_RADIUS_M, VACUUM_PERMEABILITY
from tests.rigs.diffusion import DiffusionParameters, magnetise

RATED = DiffusionParameters()
STEP_S = 1e-5
PERMEABILITY = 7.0
# Far below its knee the curve is a line, and one free cell has no hysteresis.
LINEAR = replace(
    RATED,
    saturation_a_per_m=(PERMEABILITY - 1.0) * 1e12,
    knee_a_per_m=1e12,
    cells=1,
    free_fraction=1.0,
    shells=24,
)


def shells(rods, halves_a_per_m, bias=0.0):
    """H and M of each shell after each step; the field at the surface is given, and the bias."""
    model = rods.rods(Coil(1.0, bias, STEP_S))
    model.rest()
    found = np.empty(((halves_a_per_m.size - 1) // 2, 2, rods.shells))
    for k in range(found.shape[0]):
        model.follow(halves_a_per_m[2 * k : 2 * k + 3], np.empty(1))
        found[k] = model.state[:2]
    return found[:, 0], found[:, 1]


def sine(amplitude, frequency_hz, cycles):
    n = round(cycles / (frequency_hz * STEP_S))
    return amplitude * np.sin(np.pi * frequency_hz * STEP_S * np.arange(2 * n + 1))


def phasor(signal, frequency_hz):
    """Complex amplitude of the last cycle, of the sine that began with the first step."""
    n = round(1.0 / (frequency_hz * STEP_S))
    time = STEP_S * np.arange(signal.shape[0] - n + 1, signal.shape[0] + 1)
    turn = np.exp(-2j * np.pi * frequency_hz * time)
    return 2j / n * (signal[-n:].T @ turn)


@pytest.mark.parametrize("frequency_hz", [50.0, 250.0, 1000.0])
class TestLinearRod:
    """Where mu is constant the field is known: H_s J_0(kr) / J_0(kR), k^2 = -j w mu / rho."""

    def test_skin_effect(self, frequency_hz):
        """Each shell has the field of the Bessel function at its middle, amplitude and phase."""
        field, _ = shells(LINEAR, sine(1000.0, frequency_hz, 12.0))
        omega = 2.0 * np.pi * frequency_hz
        k = np.sqrt(-1j * omega * PERMEABILITY * VACUUM_PERMEABILITY / LINEAR.resistivity_ohm_m)
        radius = (np.arange(LINEAR.shells) + 0.5) * ROD_RADIUS_M / LINEAR.shells
        expected = 1000.0 * jv(0, k * radius) / jv(0, k * ROD_RADIUS_M)
        np.testing.assert_allclose(phasor(field, frequency_hz), expected, atol=4.0)

    def test_mean_of_few_shells(self, frequency_hz):
        """Eight shells give the mean over the section within 1 %: 2 J_1(kR) / (kR J_0(kR))."""
        few = replace(LINEAR, shells=8)
        field, _ = shells(few, sine(1000.0, frequency_hz, 12.0))
        mean = phasor(field, frequency_hz) @ few.areas()
        omega = 2.0 * np.pi * frequency_hz
        k = np.sqrt(-1j * omega * PERMEABILITY * VACUUM_PERMEABILITY / few.resistivity_ohm_m)
        kr = k * ROD_RADIUS_M
        assert abs(mean - 2000.0 * jv(1, kr) / (kr * jv(0, kr))) < 0.01 * abs(mean)


def test_flux_is_kept():
    """What comes in through the surface is what H + M grow by, cells and all."""
    halves = sine(30e3, 250.0, 1.3)
    field, magnetised = shells(RATED, halves, 44.1e3)
    field = np.vstack([np.full(8, 44.1e3), field])
    grown = (field[-1] + magnetised[-1]) @ RATED.areas() - 44.1e3
    grown -= 7.65e5 * 44.1e3 / (27e3 + 44.1e3)
    gap = halves[::2] + 44.1e3 - field[:, -1]
    # Through the outer face, half a shell away: 2 pi R rho dH/dr, by the trapezoidal rule in time.
    slope = np.trapezoid(gap, dx=STEP_S) / (0.5 * ROD_RADIUS_M / 8.0)
    through = 2.0 / ROD_RADIUS_M * RATED.resistivity_ohm_m / VACUUM_PERMEABILITY * slope
    assert grown == pytest.approx(through, rel=1e-9)


def test_slow_field_is_the_same_everywhere():
    """At 0.5 Hz there is no skin effect."""
    n = 200_000
    model = RATED.rods(Coil(5.09e3, 44.1e3, STEP_S))
    model.rest()
    model.follow(6.0 * np.sin(np.pi * 0.5 * STEP_S * np.arange(2 * n + 1)), np.empty(n))
    assert np.ptp(model.state[0]) < 100.0


def test_cells_hold_until_the_field_is_beyond_their_pinning():
    """A shell's M follows cells that rest inside their pinning field, and so does its slope."""
    cells = np.array([[0.0, 1000.0], [0.25, 0.75]])
    pinned = np.array([[5000.0, 5000.0], [5000.0, 5000.0]])
    state = np.array([[5600.0, 6600.0], [0.0, 0.0], [0.0, 0.0]])
    magnetise(state, pinned, cells, (4e5, 5000.0), True)
    curve = {h: 4e5 * h / (5000.0 + h) for h in (5000.0, 5600.0, 6600.0)}
    np.testing.assert_allclose(state[1, 0], 0.25 * curve[5600.0] + 0.75 * curve[5000.0])
    np.testing.assert_allclose(state[1, 1], 0.25 * curve[6600.0] + 0.75 * curve[5600.0])
    np.testing.assert_allclose(state[2, 0], 0.25 * 4e5 * 5000.0 / 10_600.0**2)
    assert pinned.tolist() == [[5000.0, 5000.0], [5000.0, 5000.0]]
    magnetise(state, pinned, cells, (4e5, 5000.0), False)
    assert pinned.tolist() == [[5600.0, 6600.0], [5000.0, 5600.0]]


@pytest.mark.parametrize(("frequency_hz", "closes"), [(2.0, True), (250.0, False)])
def test_minor_loops_close_only_where_the_field_has_time(frequency_hz, closes):
    """Friction remembers where a slow field turned; a fast one is elsewhere in each shell."""
    n = round(1.0 / (frequency_hz * STEP_S))
    up = np.linspace(0.0, 10e3, 2 * n + 1)
    dip = 10e3 - 4e3 * (1.0 - np.cos(np.pi * np.arange(1, 2 * n + 1) / n))
    _, magnetised = shells(RATED, np.concatenate([up, dip]), 44.1e3)
    mean = magnetised @ RATED.areas()
    gap = abs(mean[-1] - mean[n - 1]) / np.ptp(mean[n - 1 :])
    assert bool(gap < 0.003) == closes


@pytest.mark.parametrize("frequency_hz", [20.0, 250.0])
@pytest.mark.parametrize("amplitude", [2e3, 30e3])
def test_loops_take_energy(frequency_hz, amplitude):
    """The area of a steady loop of applied field and mean flux is what it turns to heat."""
    halves = sine(amplitude, frequency_hz, 4.0)
    field, magnetised = shells(RATED, halves, 44.1e3)
    n = round(1.0 / (frequency_hz * STEP_S))
    flux = (field + magnetised)[-n - 1 :] @ RATED.areas()
    assert VACUUM_PERMEABILITY * float(np.diff(flux) @ halves[-2 * n :: 2]) > 0.0


@pytest.mark.slow
def test_is_its_differential_equation():
    """Another solver of the same shells, written down anew, agrees within 0.2 %, loops and all."""
    rods = replace(RATED, shells=4, cells=4)
    halves = sine(30e3, 200.0, 0.9)
    width = ROD_RADIUS_M / 4.0
    faces = width * np.arange(5)
    middles = faces[:-1] + 0.5 * width
    pinning, shares = rods.cell_table()

    def rates(time_s, field, before):
        surface = 44.1e3 + 30e3 * np.sin(2.0 * np.pi * 200.0 * time_s)
        slope = np.append(np.diff(field) / width, (surface - field[-1]) / (0.5 * width))
        flux = np.insert(faces[1:] * slope, 0, 0.0)
        into = rods.resistivity_ohm_m / VACUUM_PERMEABILITY * np.diff(flux) / (middles * width)
        beyond = np.abs(field - before) >= pinning[:, None]
        cell = np.clip(before, field - pinning[:, None], field + pinning[:, None])
        part = shares[:, None] * 7.65e5 * 27e3 / (27e3 + np.abs(cell)) ** 2
        return into / (1.0 + np.sum(np.where(beyond, part, 0.0), axis=0))

    found, _ = shells(rods, halves, 44.1e3)
    field, before = np.full(4, 44.1e3), np.full((4, 4), 44.1e3)
    solved = np.empty_like(found)
    for k in range(found.shape[0]):  # cells move between parts, so that rates have no memory
        span = (k * STEP_S, (k + 1) * STEP_S)
        field = solve_ivp(rates, span, field, args=(before,), rtol=1e-5, atol=0.1).y[:, -1]
        before = np.clip(before, field - pinning[:, None], field + pinning[:, None])
        solved[k] = field
    assert np.abs(found - solved).max() < 0.002 * 60e3
