"""Plays, drags and losses of an effective field: against their equations in plain Python."""

import math

import numpy as np
import pytest

from hilctl.kernels.field import (
    drag_step,
    field_forward,
    field_inverse,
    field_left,
    lost_field,
    mapped,
    play_paths,
)
from hilctl.kernels.hysteresis import rest_memory

THRESHOLDS, LENGTHS = np.array([0.0, 0.8]), np.array([0.5, 2.0])
LOWEST, WIDTH, CELLS = -4.0, 2.0, 4
EDGES = LOWEST + WIDTH * np.arange(CELLS + 1)
PLAYS = np.array([[1.0, 2.0, 1.5, 0.5], [0.5, 1.0, 0.0, 2.0]])
DRAGS = np.array([[0.0, 1.0, 0.5, 1.0], [1.0, 0.5, 2.0, 0.0]])
VALUES = np.insert(np.cumsum(PLAYS * WIDTH, axis=1), 0, 0.0, axis=1)
BANK = (
    THRESHOLDS,
    LENGTHS,
    (VALUES - VALUES[:, [2]]).ravel(),  # the third edge is at 0
    DRAGS.ravel(),
    np.array([LOWEST, WIDTH, CELLS, WIDTH, CELLS, 0.0, 0.0, 0.0]),
)
CREEP, PACE = 0.3, 0.5
CREEPING = (*BANK[:-1], np.array([LOWEST, WIDTH, CELLS, WIDTH, CELLS, CREEP, PACE, 0.0]))
SPAN = (-12.0, 12.0, 1e-10)
LOSSES = (3.0, 0.4, 0.6, 0.1, 0.02, 0.05, 0.2, 0.01, -0.4 / math.log(0.6), 0.55)
NO_LOSSES = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 1.0)
CURVE = (np.array([-50.0, 0.0, 50.0]), np.array([-40.0, 0.0, 60.0]))
SAME = (np.array([0.0, 1.0]), np.array([0.0, 1.0]))
LINE = (  # one play without a threshold, of slope 2
    np.zeros(1),
    np.zeros(0),
    np.array([-8.0, 8.0]),
    np.zeros(0),
    np.array([-4.0, 8.0, 1.0, 8.0, 1.0, 0.0, 0.0, 0.0]),
)


def memory(bank):
    thresholds, lengths, _, weights, _ = bank
    return rest_memory(thresholds.size + weights.size + 3 * lengths.size + 5)


def run(kernel, signal, bank=BANK, coupling=0.05, losses=LOSSES, curve=CURVE):
    out = np.empty_like(signal)
    kernel(signal, SPAN, bank, coupling, losses, curve, memory(bank), out)
    return out


def path():
    """Return loops within loops that leave the cells, with jumps over several: float64[500]."""
    t = np.arange(500) / 100.0
    u = 0.7 + 2.8 * np.sin(2.3 * t) + 1.9 * np.sin(7.1 * t)
    u[200:220] += 3.5
    u[350:] -= 1.0
    return u


def operators(u):
    """Return the sum of all plays and drags along a path from rest, cell by cell."""
    lows, tops = EDGES[:-1].copy(), EDGES[1:].copy()
    lows[0], tops[-1] = -math.inf, math.inf  # plays go on beyond the cells
    plays, last = np.zeros(THRESHOLDS.size), 0.0
    rest = np.clip(-EDGES[:-1], 0.0, WIDTH)
    drags = np.tile(rest, (LENGTHS.size, 1))
    out = []
    for now in u:
        plays = np.maximum(now - THRESHOLDS, np.minimum(now + THRESHOLDS, plays))
        ways = np.clip(plays[:, None], lows, tops) - np.clip(0.0, lows, tops)
        for i, j in np.ndindex(drags.shape):
            drags[i, j] = drag_step(drags[i, j], EDGES[j], WIDTH, last, now, LENGTHS[i])
        out.append((PLAYS * ways).sum() + (DRAGS * (drags - rest)).sum())
        last = now
    return np.array(out)


def h(e, losses):
    _, _, _, b, c, x, g, e_0, *_ = losses
    size = abs(e)
    near = min(g * size, 0.9)
    grown = size if g == 0.0 else (near / (1.0 - near) + (g * size - near) / (1.0 - near) ** 2) / g
    more = b * size + c * size**2 + x / math.sqrt(size + e_0)
    return math.copysign(grown + size * more, e)


def commands(w, m, losses):
    """Return what leaves the field w, for a run that has stood at its first command for ever."""
    out, z = [w[0]], 0.0
    for k in range(1, w.size):
        e = losses[0] * (w[k] - w[k - 1]) + losses[1] * (m[k] - m[k - 1])
        mean = losses[8] * z + (1.0 - losses[8]) * h(e, losses)
        z = losses[2] * z + (1.0 - losses[2]) * h(e, losses)
        out.append(w[k - 1] + losses[9] * (w[k] - w[k - 1]) + mean)
    return np.array(out)


@pytest.mark.parametrize("coupling", [-0.2, 0.05])
@pytest.mark.parametrize("losses", [LOSSES, NO_LOSSES])
def test_model_and_inverse_are_the_equations(coupling, losses):
    u = path()
    m = operators(u)
    command = commands(u - coupling * m, m, losses)
    y = np.interp(m, *CURVE)
    assert np.ptp(m) > 20.0
    given = {"coupling": coupling, "losses": losses}
    np.testing.assert_allclose(run(field_forward, command, **given), y, atol=1e-7)
    np.testing.assert_allclose(run(field_inverse, y, **given), command, atol=1e-7)


def play_along(u, threshold=0.8, creep=CREEP, pace=PACE, length=0.0):
    out, by = np.empty((2, 1, u.size))
    rows = np.arange(u.size)
    play_paths(u, np.ones(u.size), np.array([threshold]), creep, pace, length, rows, out, by)
    return out[0], by[0]


def test_a_play_that_creeps_follows_its_equation():
    u = 2.5 * np.sin(np.arange(200) / 20.0)
    held, last, expected = 0.0, 0.0, []
    for now in u:
        for part in np.linspace(last, now, 101)[1:]:
            ahead = part - held
            rate = CREEP * PACE * math.exp((abs(ahead) - 0.8) / CREEP) / 100
            held += math.copysign(min(rate, abs(ahead)), ahead)
        last = now
        expected.append(held)
    assert play_along(u)[0] == pytest.approx(np.array(expected), abs=1e-2)


def test_a_play_creeps_with_the_logarithm_of_time_towards_the_static_one():
    held = play_along(np.full(10_000, 6.0), 4.0)[0]
    decades = np.diff(held[[9, 99, 999, 9999]])
    assert decades == pytest.approx(CREEP * math.log(10.0), rel=0.1)
    static = play_along(path(), creep=0.0)[0]
    assert play_along(path(), creep=1e-3, pace=1.0)[0] == pytest.approx(static, abs=0.02)


def test_a_play_that_accommodates_follows_its_equation():
    u = path()
    held, last, expected = 0.0, 0.0, []
    for now in u:
        for part in np.linspace(last, now, 101)[1:]:
            if (now - last) * (part - held) > 0.0:
                held += (part - held) * abs(now - last) / 100.0 / 5.0
            held = min(max(held, part - 0.8), part + 0.8)
        last = now
        expected.append(held)
    assert play_along(u, creep=0.0, length=5.0)[0] == pytest.approx(np.array(expected), abs=2e-3)


def test_small_loops_accommodate():
    """They move a play to their middle, within its threshold; whole paths are exact."""
    u = np.concatenate((np.linspace(0.0, 3.0, 50), 2.0 + np.cos(np.arange(5000) / 10.0)))
    held = play_along(u, 2.0, creep=0.0, length=20.0)[0]
    assert held[49] == pytest.approx(1.0, abs=0.1)
    assert held[-1000:].mean() == pytest.approx(2.0, abs=0.05)
    coarse = play_along(np.array([3.0, 1.0, 2.5]), 2.0, creep=0.0, length=20.0)[0]
    turns = [np.linspace(a, b, 30) for a, b in ((0.0, 3.0), (3.0, 1.0), (1.0, 2.5))]
    fine = play_along(np.concatenate(turns), 2.0, creep=0.0, length=20.0)[0]
    assert fine[29::30] == pytest.approx(coarse, abs=1e-12)


@pytest.mark.parametrize(("creep", "length"), [(0.0, 0.0), (CREEP, 0.0), (0.0, 5.0)])
def test_the_slope_of_a_play_by_its_threshold(creep, length):
    u = np.ascontiguousarray(path()[::7])
    low, high = (play_along(u, 0.8 + d, creep, length=length)[0] for d in (-1e-6, 1e-6))
    by = play_along(u, creep=creep, length=length)[1]
    assert by == pytest.approx((high - low) / 2e-6, abs=1e-4)


def test_the_inverse_undoes_plays_that_creep():
    y = np.interp(operators(path()), *CURVE)
    command = run(field_inverse, y, CREEPING)
    assert run(field_forward, command, CREEPING) == pytest.approx(y, abs=1e-6)
    assert np.ptp(command - run(field_inverse, y)) > 0.1


def test_the_first_command_counts_as_having_stood_for_ever():
    """m = s u and u = w + coupling m give m = s w / (1 - coupling s), and nothing more comes."""
    held = np.full(4, 1.5)
    out = run(field_forward, held, LINE, coupling=0.1, curve=SAME)
    assert out == pytest.approx(2.0 * 1.5 / (1.0 - 0.1 * 2.0))


def test_drags_have_cells_of_their_own():
    length, u = 2.0, np.array([0.5, 1.5, -1.0])
    plays = np.array([-8.0, -4.0, 0.0, 4.0, 8.0])
    bank = (
        np.zeros(1), np.array([length]), 2.0 * plays, np.array([3.0]),
        np.array([-8.0, 4.0, 4.0, -4.0 + 20.0, 1.0, 0.0, 0.0]),
    )  # fmt: skip
    held, m, last = 8.0, [], 0.0
    for now in u:
        held = drag_step(held, -8.0, 16.0, last, now, length)
        m.append(2.0 * now + 3.0 * (held - 8.0))
        last = now
    m = np.array(m)
    command = commands(u, m, NO_LOSSES)
    given = {"bank": bank, "coupling": 0.0, "losses": NO_LOSSES, "curve": SAME}
    np.testing.assert_allclose(run(field_inverse, m, **given), command, atol=1e-7)


@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_beyond_the_span_its_end_is_what_comes_nearest(sign):
    far = np.array([sign * 1e6])
    given = {"bank": LINE, "coupling": 0.1, "losses": NO_LOSSES, "curve": SAME}
    assert run(field_forward, far, **given) == pytest.approx(sign * 2.0 * 12.0)
    assert run(field_inverse, far, **given) == pytest.approx(sign * 12.0 * (1.0 - 0.1 * 2.0))


@pytest.mark.parametrize("length", [0.3, 2.0])
@pytest.mark.parametrize(("held", "last", "u"), [
    (0.2, 1.4, 2.1),
    (0.2, 0.0, 5.0),
    (1.3, 1.1, 2.9),
    (0.9, 2.5, 0.4),
    (1.5, 6.0, -3.0),
    (0.4, 2.2, 1.7),
    (0.7, -3.0, 0.9),
])  # fmt: skip
def test_a_drag_is_its_differential_equation(held, last, u, length):
    """ds/d|u| = (s_u - s) / k where that is the way u goes, else 0; here in steps of 1e-3."""
    low, width, count = 1.0, 1.5, round(abs(u - last) / 1e-3)
    s, way, step = held, math.copysign(1.0, u - last), abs(u - last) / count
    for k in range(count):
        middle = last + (k + 0.5) * (u - last) / count
        behind = min(max(middle - low, 0.0), width) - s
        s += behind * -math.expm1(-step / length) if behind * way > 0.0 else 0.0
    assert drag_step(held, low, width, last, u, length) == pytest.approx(s, abs=2e-5)


def test_a_line_through_points_goes_on_straight():
    knots, values = np.array([-1.0, 0.0, 2.0, 3.0]), np.array([-4.0, 0.0, 1.0, 4.0])
    places = [-2.0, -1.0, -0.5, 0.0, 1.0, 2.0, 3.0, 5.0]
    wanted = [-8.0, -4.0, -2.0, 0.0, 0.5, 1.0, 4.0, 10.0]
    assert [mapped(x, knots, values) for x in places] == pytest.approx(wanted)


def test_lost_field_by_hand():
    losses = (0.0, 0.0, 0.0, 0.1, 0.02, 0.5, 0.3, 0.25, 0.0, 0.5)
    assert lost_field(2.0, losses)[0] == pytest.approx(2.0 * (2.5 + 0.2 + 0.08 + 0.5 / 1.5))
    assert lost_field(-2.0, losses) == (-lost_field(2.0, losses)[0], lost_field(2.0, losses)[1])


@pytest.mark.parametrize("only", [3, 4, 5, 6])
@pytest.mark.parametrize("e", [-3.0, -0.2, 0.0, 0.01, 0.4, 5.0])
def test_the_slope_of_the_losses_is_their_derivative(only, e):
    losses = (*(0.7 if i == only else 0.0 for i in range(7)), 0.25, 0.0, 0.5)
    rise = lost_field(e + 1e-5, losses)[0] - lost_field(e - 1e-5, losses)[0]
    assert lost_field(e, losses)[1] == pytest.approx(rise / 2e-5, rel=1e-4)


@pytest.mark.parametrize("step_s", [1.0, 2e-5])
def test_the_field_left_is_the_one_that_the_losses_were_added_to(step_s):
    w, m = path(), 5.0 * np.cos(np.arange(500) / 9.0)
    left, late, steps_s = np.empty_like(w), np.full(w.size, LOSSES[9]), np.full(w.size, step_s)
    field_s, output_s = step_s * LOSSES[0], step_s * LOSSES[1]
    losses = (field_s, output_s, -step_s / math.log(LOSSES[2]), *LOSSES[3:])
    field_left(commands(w, m, LOSSES), late, steps_s, m, losses, left)
    np.testing.assert_allclose(left, w, atol=1e-4 * np.abs(np.diff(w)).max())
