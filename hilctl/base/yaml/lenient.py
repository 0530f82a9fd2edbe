"""What people write and YAML has otherwise: a decimal comma, a micro sign, ``1e3`` for a count.

Such a value is read where a model wants a number, or one of a few words, and where there is one
way only to read it: ``1,5`` is 1.5, but ``1,500`` may be a thousand and a half, and is refused.
"""

import re
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from pydantic import BaseModel, ValidationError

from hilctl.base.yaml.messages import BrokenRule, Loc, located

_COMMA = re.compile(r"([-+]?\d+),(\d+)((?:[eE][-+]?\d+)?)")
_MICRO = str.maketrans({"\N{MICRO SIGN}": "u", "\N{GREEK SMALL LETTER MU}": "u"})


@dataclass(frozen=True, slots=True)
class PlainReading:
    """How a value, or a key, that stands otherwise in a file is read.

    Attributes:
        loc: Where it stands.
        value: What it is read as; of a key, its name.
        is_key: Whether it is the key that is read otherwise.
        said: What people must be told of it; empty where there is nothing to wonder about.
    """

    loc: Loc
    value: Any
    is_key: bool = False
    said: str = ""


def readings(error: ValidationError, model: type[BaseModel]) -> list[PlainReading]:
    """Return what can be read otherwise of what pydantic has refused.

    Args:
        error: What it says.
        model: What it tried to build.
    """
    broken = (located(model, detail) for detail in error.errors(include_url=False))
    return [reading for each in broken if not each.of_choice for reading in _reading(each)]


def _reading(broken: BrokenRule) -> Iterator[PlainReading]:
    kind, given = broken.detail["type"], broken.detail["input"]
    if kind == "float_type" and isinstance(given, str):
        number = _decimal(given)
        if number is not None:
            yield PlainReading(broken.loc, number, said=f"{given!r} is read as {number:g}")
    elif kind == "int_type" and isinstance(given, float) and given.is_integer():
        if abs(given) < 2.0**53:
            yield PlainReading(broken.loc, int(given))
    elif kind == "literal_error" and isinstance(given, str):
        word = given.translate(_MICRO)
        if word != given and repr(word) in str(broken.detail.get("ctx", {}).get("expected")):
            yield PlainReading(broken.loc, word)
    elif kind == "extra_forbidden" and broken.parent is not None:
        key = str(broken.loc[-1])
        plain = key.translate(_MICRO)
        if plain != key and plain in broken.parent.model_fields:
            yield PlainReading(broken.loc, plain, is_key=True)


def _decimal(text: str) -> float | None:
    """Return a number with a decimal comma; None where it may be another one, or is none."""
    found = _COMMA.fullmatch(text.strip())
    if found is None:
        return None
    whole, part, power = found.groups()
    digits = whole.lstrip("+-")
    if len(part) == 3 and len(digits) <= 3 and not digits.startswith("0"):
        return None
    return float(f"{whole}.{part}{power}")
