"""Base of all pydantic models, the pydantic names that models use, and the texts of its errors."""

import re
from collections.abc import Iterable, Mapping
from typing import Any, ClassVar, Self

from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    PlainSerializer,
    PrivateAttr,
    StringConstraints,
    ValidationError,
    ValidationInfo,
    WithJsonSchema,
    field_validator,
    model_validator,
)
from pydantic.json_schema import GenerateJsonSchema
from pydantic_core import ErrorDetails
from pydantic_core import PydanticKnownError as KnownError

__all__ = [
    "HALF_CHARACTER", "AfterValidator", "BeforeValidator", "CheckedModel", "Field", "KeySchema",
    "KnownError", "PlainSerializer", "PrivateAttr", "StrictModel", "StringConstraints",
    "ValidationError", "ValidationInfo", "WithJsonSchema", "field_validator", "first_problem",
    "model_validator", "without_halves",
]  # fmt: skip


_RULES = {
    "missing": "is required",
    "extra_forbidden": "unknown key",
    "float_type": "must be a number",
    "int_type": "must be a whole number",
    "int_from_float": "must be a whole number",
    "string_type": "must be text",
    "bool_type": "must be true or false",
    "tuple_type": "must be a list",
    "dict_type": "must be a mapping of keys to values",
    "model_type": "must be a mapping of keys to values",
    "model_attributes_type": "must be a mapping of keys to values",
    "finite_number": "must be a finite number",
    "union_tag_not_found": "needs a {discriminator}",
    "greater_than": "must be > {gt}",
    "greater_than_equal": "must be >= {ge}",
    "less_than": "must be < {lt}",
    "less_than_equal": "must be <= {le}",
    "too_short": "must have at least {min_length} values",
    "too_long": "must have at most {max_length} values",
    "string_too_short": "must have at least {min_length} characters",
    "string_pattern_mismatch": "must match the pattern {pattern}",
    "value_error": "{error}",
}
WORDS = {"literal_error", "union_tag_invalid"}
"""Error types of values outside a list of words."""


def rule_of(detail: ErrorDetails) -> str:
    """Return the rule that a value breaks."""
    kind = detail["type"]
    if kind in _RULES:
        return _RULES[kind].format(**detail.get("ctx", {}))
    if kind in WORDS:
        words = expected(detail)
        several = " or " in words or ", " in words
        return f"must be one of {words}" if several else f"must be {words}"
    return detail["msg"][0].lower() + detail["msg"][1:]


def expected(detail: ErrorDetails) -> str:
    """Return the words that a value must be one of."""
    context = detail.get("ctx", {})
    return str(context.get("expected") or context.get("expected_tags"))


HALF_CHARACTER = "contains half a character (an escape from \\ud800 to \\udfff)"
"""Rule for texts that UTF-8 cannot encode."""
_ESCAPES = re.compile(
    r"\\u[dD][89abAB]\w\w\\u[dD][c-fC-F]\w\w|(\\u[dD][89a-fA-F]\w\w)|\\.", re.DOTALL
)


def without_halves(json_text: str) -> str:
    """Return a JSON text with U+FFFD for each escape of half a character.

    Browsers may cut a text within a character, and the JSON parser rejects half characters.
    """
    return _ESCAPES.sub(lambda escape: "\\ufffd" if escape[1] else escape[0], json_text)


def first_problem(error: ValidationError, whole: str = "message") -> str:
    """Return the place and text of the first problem; ``whole`` names the place of all data."""
    first = error.errors(include_url=False)[0]
    return f"{'.'.join(map(str, first['loc'])) or whole}: {rule_of(first)}"


class KeySchema(GenerateJsonSchema):
    """JSON schema without a title of each key, which repeats its name."""

    def field_title_should_be_set(self, schema: Any) -> bool:
        """Return whether a key has a title: never."""
        return False


class StrictModel(BaseModel):
    """A frozen model that rejects unknown keys, other types, NaN and infinity."""

    REMOVED: ClassVar[Mapping[str, str]] = {}
    """Keys of earlier releases, each with its remedy."""

    model_config = ConfigDict(frozen=True, strict=True, extra="forbid", allow_inf_nan=False)

    @classmethod
    def described_by(cls, data: Any) -> "type[StrictModel]":
        """Return the class that validates data: a subclass if the data name one."""
        return cls


class CheckedModel(StrictModel):
    """A model with conditions on several keys; one error lists every broken one."""

    def _problems(self) -> Iterable[str]:
        """Return the broken conditions."""
        return ()

    @model_validator(mode="after")
    def _check(self) -> Self:
        if text := "; ".join(self._problems()):
            raise ValueError(text)
        return self
