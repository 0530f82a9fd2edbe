"""The base of all pydantic models: no coercion, no unknown keys, no changes."""

import pytest
from pydantic import ValidationError

from hilctl.base.strict import StrictModel, without_halves


class Gain(StrictModel):
    gain: float
    plays: int = 1


@pytest.mark.parametrize("given", [
    {"gain": "1.0"},
    {"gain": True},
    {"gain": float("nan")},
    {"gain": float("inf")},
    {"gain": 1.0, "plays": 2.0},
    {"gain": 1.0, "gian": 1.0},
    {},
])  # fmt: skip
def test_values_of_other_types_are_refused(given):
    with pytest.raises(ValidationError):
        Gain.model_validate(given)


def test_models_do_not_change():
    with pytest.raises(ValidationError, match="frozen"):
        Gain(gain=1.0).gain = 2.0


@pytest.mark.parametrize(("text", "whole"), [
    (r'"\ud83d\ude00"', r'"\ud83d\ude00"'),
    (r'"\\ud83d"', r'"\\ud83d"'),  # a backslash, and no escape
    (r'"\\\ud83d"', r'"\\\ufffd"'),
    (r'"\uD83D\ud83d\uDE00"', r'"\ufffd\ud83d\uDE00"'),
    (r'"\udE00 \ud83d"', r'"\ufffd \ufffd"'),
    (r'"\ud8"', r'"\ud8"'),
])  # fmt: skip
def test_halves_of_characters_are_replaced(text, whole):
    assert without_halves(text) == whole
