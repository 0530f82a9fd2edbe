"""The generalised Duhem operator: against its differential equation, and its own derivatives."""

import math

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.interpolate import RegularGridInterpolator

from hilctl.kernels.generalised_duhem import duhem_columns, duhem_forward, duhem_inverse
from hilctl.models.generalised_duhem import band_of

UNIT, PLACES = 2.5, np.array([0, 4, 8, 12, 16, 20, 23, 25, 26, 32, 40])
NODES, ACROSS = -60.0 + UNIT * PLACES, np.linspace(-1.0, 1.0, 7)
CENTRE = 0.05 * NODES + 1e-4 * NODES**2 + 0.3
FLUX = NODES + 0.003 * NODES**2
SLOPES = np.stack(
    [
        12.0 * np.exp(-((NODES / 60.0) ** 2))[:, None] * np.exp(way * 0.8 * ACROSS) + 2.0
        for way in (1.0, -1.0)
    ]
)
NO_LOSSES = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 1.0)
LOSSES = (3.0, 0.02, 0.6, 0.1, 0.02, 0.05, 0.05, 0.01, 0.75, 0.55)


def band(slopes=SLOPES, step=math.inf):
    """Return a band; steps are as long as they may be, or shorter."""
    lines, places = np.array([CENTRE, FLUX]), (float(NODES[0]), UNIT, PLACES)
    slopes, steps, *others = band_of(slopes, lines, places, float(ACROSS[-1]))
    return slopes, np.minimum(steps, step), *others


BAND = band()


def memory(y=0.0, w=0.0):
    return np.array([y, w, 0.0, math.nan])


def run(kernel, signal, losses=LOSSES, at=BAND):
    out = np.empty_like(signal)
    kernel(signal, at, losses, memory(), out)
    return out


def fields(y, at=BAND):
    """Return the field of each displacement, from rest."""
    w = np.empty_like(y)
    duhem_columns(y, 0.0, 0.0, at, np.zeros(0, dtype=np.int64), w, np.empty((0, 0)))
    return w


def path():
    """Return loops within loops, a jump and a way out of the table: float64[600]."""
    t = np.arange(600) / 100.0
    y = 20.0 * np.sin(2.3 * t) + 14.0 * np.sin(7.1 * t) - 8.0
    y[200:220] += 30.0
    y[500:] += 20.0
    return y


@pytest.mark.parametrize(("begin", "end"), [(-50.0, 30.0), (30.0, -40.0), (-5.0, 6.0)])
def test_a_branch_is_the_solution_of_the_equation(begin, end):
    table = RegularGridInterpolator((NODES, ACROSS), SLOPES[0 if end > begin else 1])
    start = float(np.interp(begin, NODES, CENTRE)) - 0.2

    def by_y(y, w):
        off = float(np.clip(w[0] - np.interp(y, NODES, CENTRE), -1.0, 1.0))
        return [1.0 / float(table((y, off)))]

    exact = solve_ivp(by_y, (begin, end), [start], rtol=1e-9, atol=1e-9, max_step=0.5)
    assert np.abs(exact.y[0] - np.interp(exact.t, NODES, CENTRE)).max() < 1.0  # within the band
    got = np.empty(1)
    duhem_inverse(np.array([end]), band(step=0.5), NO_LOSSES, memory(begin, start), got)
    assert got[0] == pytest.approx(exact.y[0, -1], abs=2e-4)


def test_the_edge_of_the_band_is_not_left():
    flat = np.full_like(SLOPES, 1.0)  # 1 um a unit: the field would run away
    w = np.empty(1)
    for begin, end, edge in ((-50.0, 30.0, 1.0), (30.0, -50.0, -1.0)):
        start = float(np.interp(begin, NODES, CENTRE))
        duhem_inverse(np.array([end]), band(flat), NO_LOSSES, memory(begin, start), w)
        assert w[0] == pytest.approx(float(np.interp(end, NODES, CENTRE)) + edge, abs=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(5))
def test_the_field_rises_with_the_displacement_however_rough_the_table(seed):
    rng = np.random.default_rng(seed)
    rough = np.exp(rng.uniform(-2.0, 2.0, SLOPES.shape))
    targets = np.concatenate([np.linspace(-70.0, 50.0, 4001), rng.uniform(-70.0, 50.0, 500)])
    targets.sort()
    got = np.empty_like(targets)
    start = float(np.interp(5.0, NODES, CENTRE)) + rng.uniform(-1.0, 1.0)
    at = band(rough)
    for k in range(targets.size):
        duhem_inverse(targets[k : k + 1], at, NO_LOSSES, memory(5.0, start), got[k : k + 1])
    assert (np.diff(got) > 0.0).all()


def test_the_command_is_ahead_by_the_losses():
    y = path()
    w = fields(y)
    ends = np.concatenate(([NODES[0] - 50.0], NODES, [NODES[-1] + 50.0]))
    last = (FLUX[-1] - FLUX[-2]) / (NODES[-1] - NODES[-2])
    flux = np.interp(y, ends, np.concatenate(([0.0], FLUX, [FLUX[-1] + 50.0 * last])))
    field_pace, output_pace, left, growth, bend, excess, self_growth, even, mean, late = LOSSES
    z, expected = 0.0, [w[0]]
    for k in range(1, y.size):
        e = field_pace * (w[k] - w[k - 1]) + output_pace * (flux[k] - flux[k - 1])
        size = abs(e)
        assert self_growth * size < 0.9
        lost = growth * size + bend * size**2 + excess / math.sqrt(size + even)
        lost = e * (1.0 / (1.0 - self_growth * size) + lost)
        expected.append(w[k - 1] + late * (w[k] - w[k - 1]) + mean * z + (1.0 - mean) * lost)
        z = left * z + (1.0 - left) * lost
    assert run(duhem_inverse, y, LOSSES) == pytest.approx(expected, abs=1e-9)


def test_columns_are_how_the_field_changes_with_the_logarithms():
    y, rows = path()[:300], np.arange(0, 300, 7)
    columns, w = np.empty((rows.size, SLOPES.size)), np.empty_like(y)
    duhem_columns(y, 0.0, 0.0, band(step=1.0), rows, w, columns)
    assert run(duhem_inverse, y, NO_LOSSES, band(step=1.0)) == pytest.approx(w, abs=1e-12)
    largest = np.abs(columns).max(axis=0)
    for node in np.argsort(largest)[-20::4]:
        slopes = np.log(SLOPES)
        slopes.ravel()[node] += 1e-4
        change = (fields(y, band(np.exp(slopes), step=1.0)) - w)[rows] / 1e-4
        assert largest[node] > 0.01
        assert columns[:, node] == pytest.approx(change, abs=1e-3 * largest[node])


@pytest.mark.parametrize("kernel", [duhem_forward, duhem_inverse])
def test_a_memory_of_no_numbers_ends_nothing(kernel):
    out = np.empty(2)
    kernel(np.array([1.0, 2.0]), band(), LOSSES, np.full(4, math.nan), out)
