"""What holds for every admissible staged model and every reference, on random ones."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from hilctl.models.integrated import IntegratedModel
from hilctl.models.linear_stages import Compliance, FirstMode, smoothing_weights
from hilctl.models.plays import PpiModel, RdpiModel
from hilctl.models.staged import FieldLag, StagedModel

LEVEL = st.floats(-100.0, 100.0)
RATES_HZ = st.sampled_from((100.0, 5e3, 50e3, 1e6))
SIGNALS = hnp.arrays(np.float64, st.integers(1, 80), elements=LEVEL)


@st.composite
def hysteresis(draw):
    """One of the kinds a staged model may hold."""
    n = draw(st.integers(0, 5))
    steps = draw(st.lists(st.floats(1e-3, 10.0), min_size=n, max_size=n))
    parameters = {
        "direct": draw(st.floats(0.1, 10.0)),
        "weights": tuple(draw(st.lists(st.floats(0.0, 10.0), min_size=n, max_size=n))),
        "thresholds": tuple(np.cumsum(steps).tolist()),
        "output_offset_um": draw(LEVEL),
    }
    kind = draw(st.sampled_from((PpiModel, RdpiModel, IntegratedModel)))
    if kind is IntegratedModel:
        parameters["deadband"] = {"slope": draw(st.floats(0.1, 10.0))}
    if kind is RdpiModel:
        parameters["gamma_s"] = draw(st.floats(0.0, 1e-3))
    return kind(**parameters)


LAGS = st.builds(
    FieldLag,
    tau_s=st.one_of(st.floats(1e-9, 1.0), st.floats(2e-5, 1e-3)),
    growth_per_unit=st.one_of(st.just(0.0), st.floats(0.0, 100.0), st.floats(1e-12, 1e-6)),
)
STRUCTURES = st.builds(
    FirstMode,
    natural_hz=st.floats(0.1, 1e6),
    damping_ratio=st.floats(1e-3, 10.0),
    compliance=st.none()
    | st.builds(
        Compliance,
        lowest_um=LEVEL,
        cell_um=st.floats(1e-3, 100.0),
        relative=st.lists(st.floats(0.1, 10.0), min_size=2, max_size=4).map(tuple),
    ),
)
MAYBE_STRUCTURES = st.none() | STRUCTURES
SMOOTHINGS_S = st.just(0.0) | st.floats(0.0, 0.1)
NONE_S = st.just(0.0)
DELAYS_S = st.one_of(st.just(0.0), st.floats(0.0, 2e-3))


@st.composite
def models(draw, *, structures=MAYBE_STRUCTURES, delays_s=DELAYS_S, smoothings_s=SMOOTHINGS_S):
    return StagedModel.around(
        draw(hysteresis()),
        lag=draw(st.none() | LAGS),
        structure=draw(structures),
        delay_s=draw(delays_s),
        smoothing_s=draw(smoothings_s),
    )


def cut_up(operator, signal, sizes):
    parts, start = [], 0
    for size in [*sizes, signal.size]:
        parts.append(operator.process(signal[start : start + size].copy()))
        start += size
    return np.concatenate(parts)


@given(models(), RATES_HZ, SIGNALS, st.lists(st.integers(1, 20), max_size=8))
def test_any_cut_gives_the_same_bits_and_every_one_is_finite(model, rate_hz, signal, sizes):
    for direction in (model.forward, model.inverse):
        whole = direction(rate_hz).process(signal.copy())
        assert np.isfinite(whole).all()
        np.testing.assert_array_equal(cut_up(direction(rate_hz), signal, sizes), whole)


@given(models(), RATES_HZ, SIGNALS)
def test_inverse_is_bounded(model, rate_hz, signal):
    command = model.inverse(rate_hz).process(signal.copy())
    gain, width = 1.0, model.smoothing_s * rate_hz
    if (structure := model.structure) is not None:
        radian = structure.radian_s * rate_hz
        damping = 2.0 * structure.damping_ratio * radian
        undoing, _ = smoothing_weights(0.0, damping, radian**2)
        gain = np.abs(np.convolve(smoothing_weights(max(radian, width))[0], undoing)).sum()
    elif width > 0.0:
        gain = np.abs(smoothing_weights(width)[0]).sum()
    inner = model.hysteresis
    widest = max((0.0, *inner.thresholds))
    reach = np.abs(signal).max() + abs(inner.output_offset_um)
    slope = inner.deadband.slope if isinstance(inner, IntegratedModel) else 1.0
    bound = gain * reach / (slope * inner.direct) + widest
    if (lag := model.lag) is not None:
        bound += 2.0 * bound / -np.expm1(-0.2 / (rate_hz * lag.tau_s))
    assert np.abs(command).max() <= 2.0 * bound + 1e-6


@given(
    models(
        structures=st.none(), delays_s=st.integers(0, 9).map(lambda n: n / 5e3), smoothings_s=NONE_S
    ),
    SIGNALS,
)
def test_inverse_meets_what_the_lag_can_follow(model, signal):
    rate_hz = 5e3
    if isinstance(model.hysteresis, RdpiModel):
        still = model.hysteresis.model_copy(update={"gamma_s": 0.0})
        model = model.model_copy(update={"hysteresis": still})
    signal = signal / 100.0
    if model.lag is not None:
        model = model.model_copy(update={"lag": FieldLag(tau_s=model.lag.tau_s)})
    inverse = model.inverse(rate_hz)
    signal = np.concatenate((signal, np.full(inverse.preview, signal[-1])))
    command = inverse.process(signal[inverse.preview :].copy())
    rest = np.full(inverse.preview, command[-1])
    came = model.forward(rate_hz).process(np.concatenate((command, rest)))[inverse.preview :]
    scale = 1e-9 * (1.0 + np.abs(command).max() * 100.0) * 10.0
    np.testing.assert_allclose(came, signal[inverse.preview :], rtol=0.0, atol=scale)
