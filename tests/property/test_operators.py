"""What holds for every admissible model and every signal, on random ones."""

import itertools
import math

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from hilctl.kernels.hysteresis import play_sum_shared, rest_memory
from hilctl.models.integrated import DeadbandFunction, IntegratedModel
from hilctl.models.plays import PpiModel, RdpiModel, SpiModel

SAMPLE_RATE_HZ = 20_000.0
LEVEL = st.floats(-100.0, 100.0)
GROWTH_S = st.floats(0.0, 1e-3)


def signals(max_size=40):
    """Signals whose values repeat, cross and jump: float64[n]."""
    repeated = st.one_of(LEVEL, st.integers(-20, 20).map(float))
    return hnp.arrays(np.float64, st.integers(1, max_size), elements=repeated)


@st.composite
def plays(draw, *, offset=True):
    """Parameters of an admissible sum of plays, weights of 0 and tight thresholds included."""
    n = draw(st.integers(0, 12))
    weights = draw(st.lists(st.one_of(st.just(0.0), st.floats(0.0, 10.0)), min_size=n, max_size=n))
    steps = draw(st.lists(st.floats(1e-3, 10.0), min_size=n, max_size=n))
    return {
        "direct": draw(st.floats(0.1, 10.0)),
        "weights": tuple(weights),
        "thresholds": tuple(np.cumsum(steps).tolist()),
        "output_offset_um": draw(LEVEL) if offset else 0.0,
    }


@st.composite
def sides(draw, slope, sign):
    """Thresholds and weights of one side, each cumulative slope within 0.1 to 10."""
    slopes = draw(st.lists(st.floats(0.1, 10.0), max_size=8))
    steps = draw(st.lists(st.floats(1e-2, 20.0), min_size=len(slopes), max_size=len(slopes)))
    weights = np.diff([slope, *slopes])
    return tuple((sign * np.cumsum(steps)).tolist()), tuple(weights.tolist())


@st.composite
def deadbands(draw):
    slope = draw(st.floats(0.1, 10.0))
    up, up_weights = draw(sides(slope, 1.0))
    down, down_weights = draw(sides(slope, -1.0))
    return DeadbandFunction(slope=slope, up_thresholds=up, up_weights=up_weights,
                            down_thresholds=down, down_weights=down_weights)  # fmt: skip


@st.composite
def models(draw, *, growth=GROWTH_S, offset=True):
    kind = draw(st.sampled_from((PpiModel, RdpiModel, IntegratedModel)))
    parameters = draw(plays(offset=offset))
    if kind is not PpiModel:
        parameters["gamma_s"] = draw(growth)
    if kind is IntegratedModel:
        parameters["deadband"] = draw(deadbands())
    return kind(**parameters)


still_models = models(growth=st.just(0.0))


def operator_of(model, direction):
    return getattr(model, direction)(SAMPLE_RATE_HZ)


def bits(array):
    return np.ascontiguousarray(array).view(np.uint64)


def size_of(*arrays):
    """The scale that rounding errors are measured against."""
    return max(1.0, *(float(np.max(np.abs(a))) for a in arrays))


@given(models(), signals(), st.data(), st.sampled_from(("forward", "inverse")))
def test_any_cut_into_blocks_gives_the_same_bits(model, v, data, direction):
    whole = operator_of(model, direction)
    expected = whole.process(v)
    cuts = sorted(data.draw(st.lists(st.integers(0, v.size), max_size=10)))
    for edges in (cuts, range(1, v.size)):
        pieces = operator_of(model, direction)
        out = [pieces.process(block) for block in np.split(v, list(edges))]
        np.testing.assert_array_equal(bits(np.concatenate(out)), bits(expected))
        np.testing.assert_array_equal(bits(pieces.state()), bits(whole.state()))


@given(models(), signals(), st.data(), st.sampled_from(("forward", "inverse")))
def test_a_restored_state_resumes_with_the_same_bits(model, v, data, direction):
    cut = data.draw(st.integers(0, v.size))
    first = operator_of(model, direction)
    first.process(v[:cut])
    second = operator_of(model, direction)
    second.process(v[::-1].copy())
    second.restore(first.state())
    np.testing.assert_array_equal(bits(second.process(v[cut:])), bits(first.process(v[cut:])))


@given(still_models, signals())
def test_without_rate_the_model_undoes_its_inverse(model, y):
    """forward(inverse(y)) is y, and inverse(forward(v)) is v, to a relative 1e-9."""
    for first, second in (("inverse", "forward"), ("forward", "inverse")):
        between = operator_of(model, first).process(y)
        back = operator_of(model, second).process(between)
        assert np.max(np.abs(back - y)) <= 1e-9 * size_of(y, between, model.output_offset_um)


@given(plays(), signals(), st.data())
def test_with_shared_thresholds_plays_cancel(parameters, v, data):
    """Whatever widens the thresholds, model and inverse cancel when both get the same (5.7)."""
    model = RdpiModel(**parameters)
    growth = data.draw(hnp.arrays(np.float64, v.size, elements=st.floats(0.0, 20.0)))
    direct, weights, thresholds = model.inverse_parameters()
    y, back = np.empty_like(v), np.empty_like(v)
    memory = rest_memory(model.operators)
    play_sum_shared(v, growth, model.direct, np.array(model.thresholds), np.array(model.weights),
                    memory, y)  # fmt: skip
    play_sum_shared(y, model.direct * growth, direct, thresholds, weights,
                    rest_memory(model.operators), back)  # fmt: skip
    assert np.max(np.abs(back - v)) <= 1e-9 * size_of(v, y)


@given(plays(), signals())
def test_stops_and_plays_are_one_inverse(parameters, y):
    """The stop-operator compensator of a PPI is its inverse (3.11-3.24, 5.8-5.10)."""
    model = PpiModel(**parameters)
    by_stops = SpiModel(**parameters).inverse(SAMPLE_RATE_HZ).process(y)
    by_plays = model.inverse(SAMPLE_RATE_HZ).process(y)
    scale = (np.max(np.abs(y)) + abs(model.output_offset_um) + 1.0) / model.direct
    assert np.max(np.abs(by_stops - by_plays)) <= 1e-8 * scale


@given(still_models, signals(), signals(), st.floats(0.0, 50.0), st.sampled_from((1.0, -1.0)))
def test_a_larger_loop_wipes_out_what_went_on_inside(model, first, second, more, side):
    outer = size_of(first, second) + more
    run_up = [0.0, -side * outer]
    left = []
    for inside in (first, second):
        operator = model.forward(SAMPLE_RATE_HZ)
        operator.process(np.array([*run_up, *inside, side * outer]))
        left.append(operator.state())
    np.testing.assert_array_equal(left[0], left[1])


@given(still_models, signals(), st.data())
def test_without_rate_only_the_turning_points_count(model, v, data):
    values = v.tolist()
    finer, kept = values[:1], [0]
    for start, end in itertools.pairwise(values):
        between = data.draw(st.lists(st.floats(min(start, end), max(start, end)), max_size=4))
        finer.extend((*sorted(between, reverse=start > end), end))
        kept.append(len(finer) - 1)
    coarse = model.forward(SAMPLE_RATE_HZ).process(v)
    fine = model.forward(37.0 * SAMPLE_RATE_HZ).process(np.array(finer))
    np.testing.assert_array_equal(fine[kept], coarse)


@given(
    models(offset=False),
    hnp.arrays(np.float64, st.integers(1, 60), elements=st.floats(-1e150, 1e150)),
)
def test_the_inverse_is_bounded(model, y):
    command = model.inverse(SAMPLE_RATE_HZ).process(y)
    x = model.deadband.inverse()(y) if isinstance(model, IntegratedModel) else y
    assert np.all(np.isfinite(command))
    assert np.max(np.abs(command)) <= 2.0 * np.max(np.abs(x)) / model.direct * (1.0 + 1e-12)


@given(models(offset=False), signals())
def test_plays_lag_and_never_lead(model, v):
    if isinstance(model, IntegratedModel):
        model = RdpiModel(direct=model.direct, weights=model.weights, thresholds=model.thresholds)
    y = model.forward(SAMPLE_RATE_HZ).process(v)
    largest = np.maximum.accumulate(np.abs(v)) * (model.direct + math.fsum(model.weights))
    assert np.all(np.abs(y) <= largest * (1.0 + 1e-12))


@given(deadbands(), signals())
def test_deadbands_and_their_inverse_cancel(function, x):
    """Lambda^-1(Lambda(x)) and Lambda(Lambda^-1(x)) are x."""
    inverse = function.inverse()
    for first, second in ((function, inverse), (inverse, function)):
        between = first(x)
        assert np.max(np.abs(second(between) - x)) <= 1e-10 * size_of(x, between)


@given(deadbands(), st.lists(LEVEL, min_size=2, max_size=40, unique=True))
def test_deadbands_rise(function, values):
    """Every cumulative slope is > 0, so more in is more out, at 0.1 to 10 for one."""
    x = np.sort(np.array(values))
    rise, run = np.diff(function(x)), np.diff(x)
    rounding = 1e-12 * size_of(function(x))
    assert np.all(rise >= 0.0999 * run - rounding)
    assert np.all(rise <= 10.001 * run + rounding)
