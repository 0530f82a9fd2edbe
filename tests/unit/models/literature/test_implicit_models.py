"""The comparison models: Preisach, K-P, Bouc-Wen, Duhem and generalised PI, on any signal."""

import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from pydantic import ValidationError
from scipy.integrate import solve_ivp

from hilctl.models.literature.bouc_wen import BoucWenModel
from hilctl.models.literature.duhem import DuhemModel
from hilctl.models.literature.generalised_plays import GeneralisedModel, PlayEnvelope
from hilctl.models.literature.implicit_models import TOLERANCE_UM
from hilctl.models.literature.krasnoselskii import KrasnoselskiiPokrovskiiModel
from hilctl.models.literature.preisach import PreisachModel

RATE_HZ = 50_000.0
LOW, HIGH = SPAN = (-7.0, 8.0)
SLOPE = st.floats(0.05, 20.0)
OFFSET = st.floats(-100.0, 100.0)
PLAIN = {"command_span": SPAN}
PREISACH = PreisachModel(
    **PLAIN,
    thresholds=(0.0, 0.7, 1.9),
    lowest=-3.0,
    cell=2.0,
    slopes=((1.0, 2.0, 0.5), (0.0, 1.5, 3.0), (0.7, 0.0, 0.2)),
)
KP = KrasnoselskiiPokrovskiiModel(
    **PLAIN, lowest=-4.0, spacing=2.0, weights=((1.0,), (0.5, 2.0), (0.0, 3.0, 0.5))
)
BOUC_WEN = BoucWenModel(**PLAIN, direct=8.0, hysteretic=2.0, beta=0.7, gamma=-0.2)
DUHEM = DuhemModel(**PLAIN, a=0.5, b=8.0, c=5.0)


def weights(size):
    """Non-negative weights, many of them 0."""
    value = st.one_of(st.just(0.0), st.floats(0.0, 20.0))
    return st.lists(value, min_size=size, max_size=size).map(tuple)


@st.composite
def preisachs(draw):
    lines, cells = draw(st.integers(1, 6)), draw(st.integers(1, 6))
    steps = draw(st.lists(st.floats(0.01, 3.0), min_size=lines - 1, max_size=lines - 1))
    first = draw(st.lists(SLOPE, min_size=cells, max_size=cells))
    return PreisachModel(
        **PLAIN,
        thresholds=(0.0, *np.cumsum(steps).tolist()),
        lowest=draw(st.floats(-8.0, 2.0)),
        cell=draw(st.floats(0.1, 5.0)),
        slopes=(tuple(first), *(draw(weights(cells)) for _ in range(lines - 1))),
        output_offset_um=draw(OFFSET),
    )


@st.composite
def kps(draw):
    levels = draw(st.integers(1, 6))
    spacing = (HIGH - LOW) / levels
    rows = tuple((*draw(weights(i)), draw(SLOPE) * 0.5 * spacing) for i in range(levels))
    return KrasnoselskiiPokrovskiiModel(
        **PLAIN, lowest=LOW, spacing=spacing, weights=rows, output_offset_um=draw(OFFSET)
    )


@st.composite
def bouc_wens(draw):
    beta, ratio = draw(st.floats(1e-3, 10.0)), draw(st.floats(-0.9, 1.0))
    hysteretic = draw(st.floats(0.0, 20.0))
    return BoucWenModel(
        **PLAIN,
        direct=draw(SLOPE) + 2.0 * hysteretic / (1.0 + ratio),
        hysteretic=hysteretic,
        beta=beta,
        gamma=ratio * beta,
        exponent=draw(st.sampled_from((1, 2))),
        output_offset_um=draw(OFFSET),
    )


@st.composite
def duhems(draw):
    slope, lag = draw(SLOPE), draw(st.floats(0.0, 20.0))
    return DuhemModel(
        **PLAIN,
        a=draw(st.floats(1e-3, 10.0)),
        b=slope + 2.0 * lag,
        c=slope + lag,
        output_offset_um=draw(OFFSET),
    )


@st.composite
def envelopes(draw):
    return PlayEnvelope(
        height=draw(st.floats(0.1, 3.0)),
        slope=draw(st.floats(0.02, 0.3)),
        shift=draw(st.floats(-1.0, 1.0)),
        level=draw(st.floats(-0.5, 0.5)),
    )


@st.composite
def generaliseds(draw):
    plays = draw(st.integers(0, 6))
    steps = draw(st.lists(st.floats(0.01, 0.5), min_size=plays, max_size=plays))
    return GeneralisedModel(
        **PLAIN,
        direct=draw(st.floats(1.0, 50.0)),
        weights=draw(weights(plays)),
        thresholds=tuple(np.cumsum(steps).tolist()),
        rising=draw(envelopes()),
        falling=draw(envelopes()),
        output_offset_um=draw(OFFSET),
    )


def signals(low, high):
    """Signals that repeat, cross and jump: float64[n]."""
    level = st.one_of(st.floats(low, high), st.integers(int(low), int(high)).map(float))
    return hnp.arrays(np.float64, st.integers(1, 60), elements=level)


MODELS = st.one_of(preisachs(), kps(), bouc_wens(), duhems(), generaliseds())


@given(MODELS, signals(*SPAN))
def test_the_model_undoes_its_inverse(model, v):
    y = model.forward(RATE_HZ).process(v)
    command = model.inverse(RATE_HZ).process(y)
    back = model.forward(RATE_HZ).process(command)
    assert np.max(np.abs(back - y)) <= 10.0 * TOLERANCE_UM


@given(MODELS, hnp.arrays(np.float64, st.integers(1, 60), elements=st.floats(-1e150, 1e150)))
def test_the_inverse_never_leaves_its_span(model, y):
    command = model.inverse(RATE_HZ).process(y)
    assert np.all((command >= LOW) & (command <= HIGH))


@given(MODELS, signals(*SPAN), st.data())
def test_a_model_rises_with_its_command(model, v, data):
    steps = sorted(data.draw(st.lists(st.floats(*SPAN), min_size=2, max_size=6)))
    after = []
    for step in steps:
        operator = model.forward(RATE_HZ)
        operator.process(v)
        after.append(operator.process(np.array([step])).item())
    assert np.all(np.diff(after) >= -1e-10 * (1.0 + np.max(np.abs(after))))


@given(MODELS, signals(*SPAN), st.floats(0.05, 0.95))
def test_samples_on_the_way_make_no_difference(model, v, part):
    between = v[:-1] + part * np.diff(v)
    finer = np.empty(2 * v.size - 1)
    finer[::2], finer[1::2] = v, between
    coarse = model.forward(RATE_HZ).process(v)
    fine = model.forward(RATE_HZ).process(finer)[::2]
    np.testing.assert_allclose(fine, coarse, rtol=1e-8, atol=1e-8)


@pytest.mark.parametrize("model", [PREISACH, KP, BOUC_WEN, DUHEM], ids=lambda m: m.kind)
def test_a_reference_that_is_not_a_number_leaves_no_trace(model):
    y = 5.0 * np.sin(np.arange(40) / 5.0)
    broken = np.insert(y, 20, np.nan)
    got = model.inverse(RATE_HZ).process(broken)
    assert np.isnan(got[20])
    np.testing.assert_array_equal(np.delete(got, 20), model.inverse(RATE_HZ).process(y))


@pytest.mark.parametrize(
    ("model", "change", "rule"),
    [
        (PREISACH, {"command_span": (1.0, 1.0)}, "command_span"),
        (PREISACH, {"cell": 0.0}, "cell must be > 0"),
        (PREISACH, {"thresholds": (0.0, 2.0, 1.0)}, "thresholds must rise"),
        (PREISACH, {"thresholds": (0.5, 0.7, 1.9)}, "first threshold must be 0"),
        (PREISACH, {"slopes": ((1.0, 0.0, 1.0),) * 3}, "first line must be > 0"),
        (PREISACH, {"slopes": ((1.0,), (-1.0,), (0.0,))}, "slopes must be >= 0"),
        (PREISACH, {"slopes": ((1.0,), (1.0, 2.0), (0.0,))}, "the same cells"),
        (PREISACH, {"slopes": ((1.0,),)}, "one line per threshold"),
        (KP, {"spacing": -1.0}, "spacing must be > 0"),
        (KP, {"weights": ()}, "at least one row"),
        (KP, {"weights": ((1.0,), (1.0,))}, "must have 2 values"),
        (KP, {"weights": ((1.0,), (1.0, 0.0))}, "the last of a row > 0"),
        (BOUC_WEN, {"gamma": 0.8}, "z to stay bounded"),
        (BOUC_WEN, {"gamma": -0.7}, "z to stay bounded"),
        (BOUC_WEN, {"direct": 5.6}, "for the inverse to exist"),
        (BOUC_WEN, {"hysteretic": -1.0}, "for the inverse to exist"),
        (DUHEM, {"a": 0.0}, "a must be > 0"),
        (DUHEM, {"c": 4.0}, "above b / 2"),
        (DUHEM, {"c": 8.1}, "at most b"),
    ],
)  # fmt: skip
def test_broken_conditions_are_refused(model, change, rule):
    with pytest.raises(ValidationError, match=rule):
        type(model)(**{**model.model_dump(exclude={"kind"}), **change})


def test_preisach_is_a_sum_of_relays():
    """Thousands of relays (1.1), each switched by itself, give the same displacement."""
    v = np.array([0.0, 2.5, -0.4, 1.3, -2.9, 2.2, -1.0, 0.1, 2.9, -2.9])
    parts = 2_000
    expected = np.zeros(v.size)
    for r, slopes in zip(PREISACH.thresholds, PREISACH.slopes, strict=True):
        width = PREISACH.cell / parts
        centres = PREISACH.lowest + width * (np.arange(3 * parts) + 0.5)
        density = np.repeat(slopes, parts)
        for k in range(v.size):
            if k == 0:
                up = centres < 0.0
                rest = np.sum(density[up])
            up = (up | (v[k] >= centres + r)) & ~(v[k] <= centres - r)
            expected[k] += width * (np.sum(density[up]) - rest)
    np.testing.assert_allclose(PREISACH.forward(RATE_HZ).process(v), expected, atol=0.02)


@given(preisachs())
def test_preisach_rests_at_its_offset(model):
    rest = model.forward(RATE_HZ).process(np.zeros(1)).item()
    assert rest == pytest.approx(model.output_offset_um, abs=1e-9)


def test_kp_follows_its_definition():
    """Each operator obeys (1.4), which tells rising from falling commands."""
    v = np.array([0.0, 1.0, 3.0, 0.5, 0.2, -3.3, -1.0, 1.7, 1.7, -0.3, 4.0, -4.5])

    def ridge(x):
        return float(np.clip(-1.0 + 2.0 * x / KP.spacing, -1.0, 1.0))

    expected = np.zeros(v.size)
    for i, row in enumerate(KP.weights):
        for j, weight in enumerate(row):
            alpha, beta = KP.lowest + KP.spacing * np.array([i, j])
            held = max(ridge(-alpha), min(ridge(-beta), 0.0))
            for k in range(v.size):
                if k and v[k] > v[k - 1]:
                    held = max(held, ridge(v[k] - alpha))
                elif k and v[k] < v[k - 1]:
                    held = min(held, ridge(v[k] - beta))
                expected[k] += weight * held
    np.testing.assert_allclose(KP.forward(RATE_HZ).process(v), expected, atol=1e-12)


@pytest.mark.parametrize("exponent", [1, 2])
@pytest.mark.parametrize("gamma", [-0.2, 0.0, 0.7])
def test_bouc_wen_solves_its_equation(exponent, gamma):
    """Between samples z is what a differential-equation solver makes of (1.21)."""
    model = BoucWenModel(
        **PLAIN, direct=10.0, hysteretic=2.0, beta=0.7, gamma=gamma, exponent=exponent
    )
    v = np.array([0.0, 4.0, -1.0, 0.5, -5.0, 6.0, -6.0])
    z, expected = 0.0, [0.0]
    for begin, end in itertools.pairwise(v):
        rate = end - begin

        def slope(_, z, rate=rate):
            size = np.abs(z)
            return (
                rate - 0.7 * abs(rate) * size ** (exponent - 1) * z - gamma * rate * size**exponent
            )

        z = solve_ivp(slope, (0.0, 1.0), [z], rtol=1e-10, atol=1e-12).y[0, -1]
        expected.append(10.0 * end - 2.0 * z)
    np.testing.assert_allclose(model.forward(RATE_HZ).process(v), expected, atol=1e-6)


def test_duhem_solves_its_equation():
    """Between samples the displacement is what a solver makes of (1.22)."""
    v = np.array([0.0, 4.0, -1.0, 0.5, -5.0, 6.0, -6.0])
    y, expected = 0.0, [0.0]
    for begin, end in itertools.pairwise(v):
        rate = end - begin

        def slope(time, y, begin=begin, rate=rate):
            command = begin + rate * time
            return DUHEM.a * abs(rate) * (DUHEM.b * command - y) + DUHEM.c * rate

        y = solve_ivp(slope, (0.0, 1.0), [y], rtol=1e-10, atol=1e-12).y[0, -1]
        expected.append(y)
    np.testing.assert_allclose(DUHEM.forward(RATE_HZ).process(v), expected, atol=1e-6)
