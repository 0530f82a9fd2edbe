"""JSON that every program can read."""

import json
import math

import pytest

from hilctl.base.finite_json import finite_json

WHOLE = {"a": [1, 0.5, None, True, "NaN"], "b": {"c": (2.5,)}}


def refuse(constant: str) -> None:
    raise ValueError(constant)


@pytest.mark.parametrize("indent", [None, 2])
def test_finite_values_stay_as_they_are(indent: int | None) -> None:
    assert finite_json(WHOLE, indent) == json.dumps(WHOLE, indent=indent)


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_what_is_not_finite_is_null(bad: float) -> None:
    text = finite_json({"x": bad, "y": [bad, 1.0], "z": {"deep": (bad, "inf")}})
    found = json.loads(text, parse_constant=refuse)
    assert found == {"x": None, "y": [None, 1.0], "z": {"deep": [None, "inf"]}}
