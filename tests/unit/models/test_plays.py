"""What a model refuses, and that the message names the condition and the index."""

import numpy as np
import pytest
from pydantic import ValidationError

from hilctl.base.errors import ConfigError, ModelError
from hilctl.models.base import HysteresisModel
from hilctl.models.integrated import DeadbandFunction, IntegratedModel
from hilctl.models.literature.generalised_plays import GeneralisedModel, PlayEnvelope
from hilctl.models.model_file import parse_model
from hilctl.models.plays import PpiModel, RdpiModel, SpiModel
from tests.published import piezo_ppi

GOOD = {"direct": 1.0, "weights": (0.5, 0.0, 0.2), "thresholds": (0.1, 0.2, 0.5)}
DEADBAND = {
    "slope": 2.0,
    "up_thresholds": (1.0, 2.0),
    "up_weights": (-0.5, -0.5),
    "down_thresholds": (-1.0, -3.0),
    "down_weights": (-0.5, 1.0),
}
KINDS = [
    (PpiModel, {}),
    (SpiModel, {}),
    (RdpiModel, {"gamma_s": 1e-4}),
    (IntegratedModel, {"gamma_s": 1e-4, "deadband": DEADBAND}),
]


def broken(kind, **parameters):
    """Return the messages of all broken rules, one a line."""
    with pytest.raises(ValidationError) as caught:
        kind(**parameters)
    return "\n".join(f"{e['loc']} {e['msg']}" for e in caught.value.errors())


@pytest.mark.parametrize(("kind", "more"), KINDS)
def test_admissible_parameters_are_taken(kind, more):
    model = kind(**GOOD, **more)
    assert isinstance(model, HysteresisModel)
    assert model.operators == 3


@pytest.mark.parametrize(("kind", "more"), KINDS)
@pytest.mark.parametrize(("change", "message"), [
    ({"direct": 0.0}, "a_0 must be > 0 for the inverse to exist: 0.0"),
    ({"direct": -0.3}, "a_0 must be > 0 for the inverse to exist: -0.3"),
    ({"weights": (0.5, -1e-9, 0.2)}, "a_2 must be >= 0 for the inverse to exist: -1e-09"),
    ({"weights": (0.5, 0.1, -2.0)}, "a_3 must be >= 0 for the inverse to exist: -2.0"),
    ({"thresholds": (0.0, 0.2, 0.5)}, "r_1 = 0.0 after 0.0"),
    ({"thresholds": (-0.1, 0.2, 0.5)}, "r_1 = -0.1 after 0.0"),
    ({"thresholds": (0.1, 0.2, 0.2)}, "the thresholds must dilate): r_3 = 0.2 after 0.2"),
    ({"thresholds": (0.1, 0.6, 0.5)}, "r_3 = 0.5 after 0.6"),
    ({"weights": (0.5, 0.1)}, "weights must have one value per threshold: 2 for 3"),
    ({"thresholds": ()}, "weights must have one value per threshold: 3 for 0"),
    ({"input_range": (2.0, 2.0)}, "the second value must be above the first: [2.0, 2.0]"),
    ({"output_range_um": (5.0, -5.0)}, "the second value must be above the first: [5.0, -5.0]"),
])  # fmt: skip
def test_each_condition_of_the_plays_is_named(kind, more, change, message):
    assert message in broken(kind, **{**GOOD, **more, **change})


def test_all_broken_conditions_are_named_at_once():
    text = broken(RdpiModel, direct=-1.0, weights=(-1.0, 0.1, -2.0), thresholds=(0.2, 0.1))
    for part in ("3 for 2", "a_0 must be", "a_1 must be", "a_3 must be", "r_2 = 0.1 after 0.2"):
        assert part in text
    both = broken(DeadbandFunction, slope=1.0, up_thresholds=(1.0,), up_weights=(-1.0,),
                  down_thresholds=(-1.0,), down_weights=(-2.0,))  # fmt: skip
    assert "g_1 = 0.0" in both
    assert "g_-1 = -1.0" in both


@pytest.mark.parametrize("value", [float("nan"), float("inf"), float("-inf")])
@pytest.mark.parametrize(
    "place", ["direct", "weights", "thresholds", "gamma_s", "output_offset_um"]
)
def test_numbers_must_be_finite(place, value):
    given = (value, 0.1, 0.2) if place in {"weights", "thresholds"} else value
    text = broken(RdpiModel, **{**GOOD, place: given})
    assert place in text
    assert "finite number" in text


@pytest.mark.parametrize(("direct", "weights", "thresholds"), [
    (1e308, (1e308,), (1.0,)), (5e-324, (1.0,), (1.0,)), (1.0, (1.0, 1.0), (1e308, 1.5e308)),
])  # fmt: skip
def test_plays_beyond_the_range_of_numbers_have_no_inverse(direct, weights, thresholds):
    model = RdpiModel(direct=direct, weights=weights, thresholds=thresholds)
    with pytest.raises(ModelError, match="too large or too small"):
        model.inverse(1_000.0)


SAMPLE_RATE_HZ = 10_000.0
PLAYS = {"direct": 2.0, "weights": (0.5, 0.3, 0.8), "thresholds": (0.2, 0.5, 1.1)}
MODELS = {
    "ppi": PpiModel(**PLAYS),
    "rdpi": RdpiModel(**PLAYS, gamma_s=3e-4),
    "integrated": IntegratedModel(
        **PLAYS,
        gamma_s=3e-4,
        deadband=DeadbandFunction(
            slope=1.2,
            up_thresholds=(1.0, 3.0),
            up_weights=(-0.3, -0.2),
            down_thresholds=(-2.0,),
            down_weights=(0.6,),
        ),
    ),
}


def test_only_the_rate_dependent_models_know_the_sample_rate():
    signal = 3.0 * np.sin(np.arange(500) / 30.0) + 0.4 * np.sin(np.arange(500) / 3.0)
    for name, model in MODELS.items():
        for make in (model.forward, model.inverse):
            same = np.array_equal(make(1_000.0).process(signal), make(9_000.0).process(signal))
            assert same == (name == "ppi")


def test_inverse_rate_is_scaled_to_the_command():
    """The inverse takes the rate of x / sum a, widened by a_0 gamma: a_0 gamma f / sum a."""
    assert MODELS["ppi"].inverse_rate_gain(SAMPLE_RATE_HZ) == 0.0
    gain = 2.0 * 3e-4 * SAMPLE_RATE_HZ / (2.0 + 0.5 + 0.3 + 0.8)
    for name in ("rdpi", "integrated"):
        assert MODELS[name].inverse_rate_gain(SAMPLE_RATE_HZ) == pytest.approx(gain, rel=1e-14)


SPI_DIRECT = 2.146
SPI_THRESHOLDS = (
    0.9108, 1.9418, 3.0797, 4.3122, 5.6285, 7.0194, 8.4762, 9.9915, 11.5587, 13.1716,
)  # fmt: skip
SPI_WEIGHTS = (
    0.4544, 0.3230, 0.2397, 0.1831, 0.1444, 0.1156, 0.0941, 0.0774, 0.0642, 0.0543,
)  # fmt: skip


def spi(ppi):
    """Return the same PPI, compensated by stops."""
    return SpiModel(**ppi.model_dump(exclude={"kind"}))


def test_spi_from_the_published_ppi():
    direct, weights, thresholds = spi(piezo_ppi()).stop_parameters()
    assert direct == pytest.approx(SPI_DIRECT, abs=0.002)
    np.testing.assert_allclose(thresholds, SPI_THRESHOLDS, rtol=0.0, atol=0.002)
    np.testing.assert_allclose(weights, SPI_WEIGHTS, rtol=0.0, atol=0.002)


def test_spi_weights_solve_the_published_equations():
    """sum_j min(s_i, s_j) w_j + s_i w_0 = r_i (3.19), s the initial loading curve at r (3.18)."""
    ppi = piezo_ppi()
    direct, weights, thresholds = spi(ppi).stop_parameters()
    r, p = np.array((0.0, *ppi.thresholds)), np.array((ppi.direct, *ppi.weights))
    loading = np.maximum(0.0, r[1:, None] - r[None, :]) @ p
    np.testing.assert_allclose(thresholds, loading, rtol=1e-13)
    left = np.minimum.outer(thresholds, thresholds) @ weights + thresholds * direct
    np.testing.assert_allclose(left, ppi.thresholds, rtol=1e-12)


def test_spi_of_a_model_without_hysteresis_is_a_gain():
    ppi = piezo_ppi().model_copy(update={"weights": (), "thresholds": ()})
    y = 3.0 * np.sin(np.arange(500) / 30.0)
    command = spi(ppi).inverse(SAMPLE_RATE_HZ).process(y)
    np.testing.assert_allclose(command, y / 0.2567, rtol=1e-15)


RATE_HZ = 50_000.0
LOW, HIGH = SPAN = (-7.0, 8.0)
PLAIN = {"command_span": SPAN}


def test_the_generalised_model_follows_its_definition():
    """Each generalised play obeys (1.17), though the model runs them behind one signal."""
    rising = PlayEnvelope(slope=0.15, shift=0.2, level=-0.2)
    falling = PlayEnvelope(height=1.1, slope=0.14, shift=0.2, level=-0.1)
    model = GeneralisedModel(
        **PLAIN, direct=20.0, weights=(5.0, 3.0), thresholds=(0.1, 0.4), rising=rising,
        falling=falling,
    )  # fmt: skip
    rng = np.random.default_rng(3)
    v = rng.uniform(-6.0, 6.0, 200)
    low = np.tanh(0.15 * v + 0.2) - 0.2
    high = np.maximum(low, 1.1 * np.tanh(0.14 * v + 0.2) - 0.1)
    expected = np.zeros(v.size)
    for r, weight in ((0.0, 20.0), (0.1, 5.0), (0.4, 3.0)):
        held = 0.0
        for k in range(v.size):
            held = max(low[k] - r, min(high[k] + r, held))
            expected[k] += weight * held
    np.testing.assert_allclose(model.forward(RATE_HZ).process(v), expected, atol=1e-12)


def test_envelopes_must_rise():
    text = """
    model: {kind: generalised, command_span: [-6.0, 6.0], direct: 1.0, weights: [],
            thresholds: [], rising: {slope: 0.1}, falling: {slope: -0.1}}
    """
    with pytest.raises(ConfigError, match=r"falling\.slope must be > 0"):
        parse_model("here", text)
