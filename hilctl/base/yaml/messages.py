"""What is said of a value that breaks a rule: the rule, the value, and what to do."""

import difflib
import math
from typing import Any

from pydantic_core import ErrorDetails

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
    "union_tag_not_found": "needs a 'kind'",
}
_WITHOUT_VALUE = {"missing", "value_error", "extra_forbidden", "union_tag_not_found"}


def rule_of(detail: ErrorDetails) -> str:
    """Return the broken rule in words."""
    return _RULES.get(detail["type"]) or _worded_rule(detail)


def value_of(detail: ErrorDetails) -> str:
    """Return the offending value, short enough for one line; empty where the rule has it."""
    if detail["type"] == "union_tag_invalid":
        return repr(detail.get("ctx", {})["tag"])
    if detail["type"] in _WITHOUT_VALUE:
        return ""
    text = _plain(detail["input"])
    return text if len(text) <= 60 else text[:57] + "..."


def _plain(value: Any) -> str:
    if value is None:
        return "nothing"
    return repr(list(value)) if isinstance(value, tuple) else repr(value)


def hint_of(detail: ErrorDetails, known: list[str]) -> str:
    """Return what to do about it, or an empty text.

    Args:
        detail: What pydantic says.
        known: Keys that would have been right beside it.
    """
    value, kind = detail["input"], detail["type"]
    if kind == "extra_forbidden":
        return did_you_mean(str(detail["loc"][-1]), known)
    if kind in {"float_type", "int_type"} and isinstance(value, str):
        return _number_hint(value)
    if isinstance(value, bool) and kind in {"float_type", "int_type", "string_type"}:
        what = "put the text in quotes" if kind == "string_type" else "write a number"
        return f"YAML reads yes, no, on and off as true and false: {what}"
    return ""


def did_you_mean(word: str, known: list[str]) -> str:
    """Return a hint with the closest known name, or with all of them."""
    close = difflib.get_close_matches(word, known, n=1)
    if close:
        return f"did you mean '{close[0]}'?"
    return f"known: {', '.join(sorted(known))}" if known else ""


def _worded_rule(detail: ErrorDetails) -> str:
    context = detail.get("ctx", {})
    kind = detail["type"]
    if kind == "value_error":
        return str(context["error"])
    bounds = {"greater_than": ("> ", "gt"), "greater_than_equal": (">= ", "ge"),
              "less_than": ("< ", "lt"), "less_than_equal": ("<= ", "le")}  # fmt: skip
    if kind in bounds:
        sign, name = bounds[kind]
        return f"must be {sign}{context[name]}"
    if kind in {"literal_error", "union_tag_invalid"}:
        expected = context.get("expected") or context.get("expected_tags")
        return f"must be one of {expected}"
    if kind in {"too_short", "too_long"}:
        name = "at least" if kind == "too_short" else "at most"
        length = context.get("min_length", context.get("max_length"))
        return f"must have {name} {length} values"
    message = detail["msg"]
    return message[0].lower() + message[1:]


def _number_hint(text: str) -> str:
    try:
        number = float(text)
    except ValueError:
        return ""
    if not math.isfinite(number):
        return ""
    mantissa, e, exponent = text.lower().partition("e")
    if e:
        dot = mantissa if "." in mantissa else mantissa + ".0"
        sign = "" if exponent[0] in "+-" else "+"
        return f"YAML reads this as text: write {number!r} or {dot}e{sign}{exponent}"
    return "remove the quotes"
