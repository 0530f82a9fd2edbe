"""Domains in eight orientations, against all eight written down anew and their limits."""

import math
from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from scipy.optimize import minimize

from hilctl_drivers.simulated.actuator_base import Coil
from tests.rigs import ROD_LENGTH_M, VACUUM_PERMEABILITY, domains

RATED = domains.DomainsParameters()
STEP_S = 1e-5
AXIS = np.array([1.0, 1.0, 2.0]) / math.sqrt(6.0)
ZEEMAN = VACUUM_PERMEABILITY * RATED.saturation_a_per_m


def strain(m):
    """Magnetostriction along the rod of a domain magnetised along the unit vector m."""
    one = 1.5 * RATED.strain_100 * (np.sum(AXIS**2 * m**2) - 1.0 / 3.0)
    pairs = [(0, 1), (0, 2), (1, 2)]
    other = 3.0 * RATED.strain_111 * sum(AXIS[i] * AXIS[j] * m[i] * m[j] for i, j in pairs)
    return float(one + other)


def energy(m, easy, field):
    stiff = 0.5 * RATED.anisotropy_j_per_m3 * np.sum((m - easy) ** 2)
    return float(stiff - ZEEMAN * field * (m @ AXIS) - RATED.stress_pa * strain(m))


def all_eight(field):
    """Fractions, m.u and strain of each <111> direction, from the published closed form."""
    form = np.empty((3, 3))
    for i, j in product(range(3), repeat=2):
        factor = RATED.strain_100 if i == j else RATED.strain_111
        form[i, j] = 3.0 * factor * AXIS[i] * AXIS[j]
    energies, along, strains = [], [], []
    for signs in product((1.0, -1.0), repeat=3):
        easy = np.array(signs) / math.sqrt(3.0)
        pull = ZEEMAN * field * AXIS + RATED.stress_pa * (form @ easy)
        m = easy + pull / RATED.anisotropy_j_per_m3
        m /= np.linalg.norm(m)
        energies.append(energy(m, easy, field))
        along.append(m @ AXIS)
        strains.append(strain(m))
    fractions = np.exp(-np.array(energies) / RATED.spread_j_per_m3)
    return fractions / fractions.sum(), np.array(along), np.array(strains)


def at_rest(field, rods=RATED):
    """M / M_s and displacement in um of the anhysteretic state."""
    model = rods.rods(Coil(1.0, field, STEP_S))
    rest_um = model.rest()
    return float((model.state[2, 1] - field) / rods.saturation_a_per_m), rest_um


@pytest.mark.parametrize("field", [-40e3, 0.0, 13e3, 44.1e3, 95e3])
def test_six_kinds_are_all_eight(field):
    """Magnetisation and strain are those of eight orientations, each for itself."""
    assert sum(domains.KIND_SIZES) == 8
    assert len(domains.ORIENTATIONS) == len(domains.KIND_SIZES)
    fractions, along, strains = all_eight(field)
    magnetised, rest_um = at_rest(field)
    assert magnetised == pytest.approx(fractions @ along, abs=1e-9)
    whole_um = 1e6 * ROD_LENGTH_M * (fractions @ strains + 0.5 * RATED.strain_100)
    assert rest_um == pytest.approx(whole_um, abs=1e-6)


@pytest.mark.parametrize("field", [-5e3, 0.0, 5e3])
def test_closed_form_is_where_the_energy_is_least(field):
    """To first order: a tenth of field and stress moves moments by a tenth, within a hundredth."""
    weak = replace(RATED, stress_pa=0.1 * RATED.stress_pa)
    work = np.empty((8, 6))
    domains.equilibrium(field, weak.table(), weak.energies, work)
    for kind, direction in enumerate(domains.ORIENTATIONS):
        easy = np.array(direction) / math.sqrt(3.0)

        def of(x, easy=easy):
            m = x / np.linalg.norm(x)
            return (energy(m, easy, field) + 0.9 * RATED.stress_pa * strain(m)) / 1e4

        best = minimize(of, easy, tol=1e-10).x
        assert work[1, kind] == pytest.approx(best @ AXIS / np.linalg.norm(best), abs=0.01)


def test_limits_of_the_anhysteretic():
    """Without a field nothing points anywhere; odd M, even strain; saturation is along u."""
    assert at_rest(0.0)[0] == pytest.approx(0.0, abs=1e-12)
    assert at_rest(30e3)[0] == pytest.approx(-at_rest(-30e3)[0], abs=1e-9)
    assert at_rest(30e3)[1] == pytest.approx(at_rest(-30e3)[1], abs=1e-6)
    curve = [at_rest(field)[0] for field in np.linspace(0.0, 1e6, 50)]
    assert curve == sorted(curve)
    magnetised, rest_um = at_rest(5e6)
    assert magnetised == pytest.approx(1.0, abs=0.01)
    full_um = 1e6 * ROD_LENGTH_M * (strain(AXIS) + 0.5 * RATED.strain_100)
    assert rest_um == pytest.approx(full_um, rel=0.05)


def test_compression_turns_domains_across():
    """More prestress: less strain at rest, and more of it to be had by a field."""
    pressed = replace(RATED, stress_pa=1.5 * RATED.stress_pa)
    assert at_rest(0.0, pressed)[1] < at_rest(0.0)[1] - 3.0
    gain = [at_rest(5e6, rods)[1] - at_rest(0.0, rods)[1] for rods in (RATED, pressed)]
    assert gain[1] > gain[0]


@pytest.mark.parametrize("change", [-300.0, 300.0, 2000.0])
def test_slopes_are_difference_quotients(change):
    """What Newton's method goes by is what a small change does."""
    model = RATED.rods(Coil(1.0, 44.1e3, STEP_S))
    model.rest()
    model.follow(np.linspace(0.0, math.copysign(9e3, change), 801), np.empty(400))
    works = [np.empty((8, 6)) for _ in range(3)]
    found = [
        domains.magnetise(change + step, model.state, RATED.table(), RATED.energies, work)
        for step, work in zip((-0.1, 0.0, 0.1), works, strict=True)
    ]
    assert found[1][1] == pytest.approx((found[2][0] - found[0][0]) / 0.2, rel=1e-6)
    for value, slope in ((0, 3), (1, 4), (2, 5), (6, 7)):
        quotient = (works[2][value] - works[0][value]) / 0.2
        np.testing.assert_allclose(works[1][slope], quotient, rtol=1e-4, atol=1e-13)


def test_fractions_stay_fractions():
    """However it is driven, they are between 0 and 1, and 1 in all."""
    model = RATED.rods(Coil(5.09e3, 44.1e3, STEP_S))
    model.rest()
    current_a = np.random.default_rng(3).uniform(-10.0, 10.0, 200).repeat(20)
    for part in np.split(current_a, 200):
        model.follow(np.append(part, part[-1]).repeat(1)[:21], np.empty(10))
        for fractions in model.state[:2]:
            assert fractions.min() >= 0.0
            assert fractions @ domains.KIND_SIZES == pytest.approx(1.0, abs=1e-9)


def test_flux_is_kept():
    """H + M by the flux that came in is what fields and fractions come to, after any motion."""
    model = RATED.rods(Coil(5.09e3, 44.1e3, STEP_S))
    model.rest()
    n = 4000
    model.follow(7.0 * np.sin(2.0 * np.pi * np.arange(2 * n + 1) / 400.0), np.empty(n))
    work = np.empty((8, 6))
    domains.equilibrium(model.state[2, 0], RATED.table(), RATED.energies, work)
    fractions = 0.1 * model.state[0] + 0.9 * model.state[1]
    by_fractions = 7.65e5 * float((RATED.table()[0] * fractions) @ work[1]) + model.state[2, 0]
    assert model.state[2, 1] == pytest.approx(by_fractions, abs=0.1)
