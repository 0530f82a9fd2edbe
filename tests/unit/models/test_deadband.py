"""The memoryless deadband function: what it refuses, and that its inverse undoes it."""

import numpy as np
import pytest
from pydantic import ValidationError

from hilctl.base.errors import ModelError
from hilctl.models.deadband import DeadbandFunction
from hilctl.models.integrated import IntegratedModel
from hilctl.models.plays import PpiModel, RdpiModel

GOOD = {"direct": 1.0, "weights": (0.5, 0.0, 0.2), "thresholds": (0.1, 0.2, 0.5)}
DEADBAND = {
    "slope": 2.0,
    "up_thresholds": (1.0, 2.0),
    "up_weights": (-0.5, -0.5),
    "down_thresholds": (-1.0, -3.0),
    "down_weights": (-0.5, 1.0),
}


def broken(kind, **parameters):
    """Return the messages of all broken rules, one a line."""
    with pytest.raises(ValidationError) as caught:
        kind(**parameters)
    return "\n".join(f"{e['loc']} {e['msg']}" for e in caught.value.errors())


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


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
@pytest.mark.parametrize("place", ["slope", "up_weights", "down_thresholds"])
def test_deadband_numbers_must_be_finite(place, value):
    """So are they in the deadbands."""
    given = value if place == "slope" else (value, 1.0)
    assert "finite number" in broken(DeadbandFunction, **{**DEADBAND, place: given})


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


def test_deadband_function_and_its_inverse_cancel():
    """Lambda after its inverse, and the other way round, return what went in."""
    function = MODELS["integrated"].deadband
    x = np.linspace(-9.0, 9.0, 2_001)
    np.testing.assert_allclose(function.inverse()(function(x)), x, rtol=0, atol=1e-13)
    np.testing.assert_allclose(function(function.inverse()(x)), x, rtol=0, atol=1e-13)
    np.testing.assert_allclose(function.inverse().inverse()(x), function(x), rtol=0, atol=1e-12)
