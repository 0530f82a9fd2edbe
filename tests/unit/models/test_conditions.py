"""What a model refuses, and that the message names the condition and the index."""

import pytest
from pydantic import ValidationError

from hilctl.base.errors import ModelError
from hilctl.models.base import HysteresisModel
from hilctl.models.deadband import DeadbandFunction
from hilctl.models.integrated import IntegratedModel
from hilctl.models.plays import PpiModel, RdpiModel
from hilctl.models.spi import SpiModel

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
    """The set that the refusals below start from is a good one."""
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
    ({"weights": (0.5, 0.1)}, "weights must have one value a threshold: 2 for 3"),
    ({"thresholds": ()}, "weights must have one value a threshold: 3 for 0"),
    ({"input_range": (2.0, 2.0)}, "the second value must be above the first: [2.0, 2.0]"),
    ({"output_range_um": (5.0, -5.0)}, "the second value must be above the first: [5.0, -5.0]"),
])  # fmt: skip
def test_each_condition_of_the_plays_is_named(kind, more, change, message):
    """Weights, thresholds, lengths, ranges: the condition, the index and the value are named."""
    assert message in broken(kind, **{**GOOD, **more, **change})


@pytest.mark.parametrize(("change", "message"), [
    ({"slope": 0.0}, "g_0 = 0.0"),
    ({"slope": -1.0}, "g_0 = -1.0"),
    ({"up_weights": (-2.0, 0.5)}, "g_0 + ... + g_1 = 0.0"),
    ({"up_weights": (-0.5, -1.75)}, "g_0 + ... + g_2 = -0.25"),
    ({"down_weights": (-2.5, 1.0)}, "g_0 + ... + g_-1 = -0.5"),
    ({"down_weights": (1.0, -4.0)}, "g_0 + ... + g_-2 = -1.0"),
    ({"up_thresholds": (0.0, 2.0)}, "d must rise from 0 (the thresholds must dilate): d_1 = 0.0"),
    ({"up_thresholds": (1.0, 1.0)}, "d_2 = 1.0 after 1.0"),
    ({"down_thresholds": (1.0, -3.0)}, "d_- must fall from 0"),
    ({"down_thresholds": (-3.0, -1.0)}, "d_-_2 = -1.0 after -3.0"),
    ({"up_weights": (1.0,)}, "up_weights must have one value a threshold: 1 for 2"),
    ({"down_weights": (1.0,)}, "down_weights must have one value a threshold: 1 for 2"),
])  # fmt: skip
def test_each_condition_of_the_deadbands_is_named(change, message):
    """Slopes, thresholds and lengths of both sides are named with their index."""
    assert message in broken(DeadbandFunction, **{**DEADBAND, **change})


def test_all_broken_conditions_are_named_at_once():
    """One error lists every condition and every index, not the first."""
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
    """NaN and the infinities are refused wherever a number stands."""
    given = (value, 0.1, 0.2) if place in {"weights", "thresholds"} else value
    text = broken(RdpiModel, **{**GOOD, place: given})
    assert place in text
    assert "finite number" in text


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
@pytest.mark.parametrize("place", ["slope", "up_weights", "down_thresholds"])
def test_deadband_numbers_must_be_finite(place, value):
    """So are they in the deadbands."""
    given = value if place == "slope" else (value, 1.0)
    assert "finite number" in broken(DeadbandFunction, **{**DEADBAND, place: given})


def test_growth_must_not_be_negative():
    """Gamma below 0 would let thresholds shrink with the rate."""
    assert "greater than or equal to 0" in broken(RdpiModel, **GOOD, gamma_s=-1e-6)


def test_numbers_are_not_guessed_from_text():
    """Text, true and None are no numbers."""
    for value in ("1.0", True, None):
        assert "valid number" in broken(PpiModel, **{**GOOD, "direct": value})


@pytest.mark.parametrize(("direct", "weights", "thresholds"), [
    (1e308, (1e308,), (1.0,)), (5e-324, (1.0,), (1.0,)), (1.0, (1.0, 1.0), (1e308, 1.5e308)),
])  # fmt: skip
def test_plays_beyond_the_range_of_numbers_have_no_inverse(direct, weights, thresholds):
    """Where the inverse's numbers overflow, it is refused, not handed out as infinities."""
    model = RdpiModel(direct=direct, weights=weights, thresholds=thresholds)
    with pytest.raises(ModelError, match="too large or too small"):
        model.inverse(1_000.0)


@pytest.mark.parametrize(("parameters", "message"), [
    ({"slope": 5e-324}, "finite number"),
    ({"slope": 1.0, "up_thresholds": (1.0, 1.0000000000000002),
      "up_weights": (-0.9999999999999999, 1.0)}, "d_2 = 1.0 after 1.0"),
    ({"slope": 1e-300, "down_thresholds": (-1.0,), "down_weights": (1e300,)}, "g_-1 = 0.0"),
])  # fmt: skip
def test_deadbands_that_rounding_takes_apart_have_no_inverse(parameters, message):
    """Slopes too far apart for the number format are refused with the reason."""
    model = IntegratedModel(**GOOD, deadband=DeadbandFunction(**parameters))
    with pytest.raises(ModelError, match=message):
        model.inverse(1_000.0)


def test_models_do_not_change():
    """Parameters are frozen."""
    model = PpiModel(**GOOD)
    with pytest.raises(ValidationError, match="frozen"):
        model.direct = 2.0
