"""Validation errors in words: place, key, rule, value, fix."""

import re
import types
import typing
import unicodedata
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Annotated, Any, NamedTuple, TypeAlias

from pydantic import BaseModel, ValidationError
from pydantic_core import ErrorDetails

from hilctl.base.errors import ConfigError, ConfigProblem
from hilctl.base.formatting import did_you_mean

Loc: TypeAlias = tuple[str | int, ...]
"""Location of a value: keys and list indices."""

NUMBERS = {
    "int": r"[-+]?[0-9]+|0o[0-7]+|0x[0-9a-fA-F]+",
    "float": r"[-+]?(?:\.[0-9]+|[0-9]+(?:\.[0-9]*)?)(?:[eE][-+]?[0-9]+)?"
    r"|[-+]?\.(?:inf|Inf|INF)|\.(?:nan|NaN|NAN)",
}
"""Regular expressions for plain numbers in YAML 1.2."""

_DASHES = {"\N{MINUS SIGN}", "\N{EN DASH}", "\N{EM DASH}"}
_QUOTED = re.compile(r"'([^']+)'")
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
    "greater_than": "must be > {gt}",
    "greater_than_equal": "must be >= {ge}",
    "less_than": "must be < {lt}",
    "less_than_equal": "must be <= {le}",
    "too_short": "must have at least {min_length} values",
    "too_long": "must have at most {max_length} values",
    "value_error": "{error}",
}
_WITHOUT_VALUE = {"missing", "value_error", "extra_forbidden", "union_tag_not_found"}
_WORDS = {"literal_error", "union_tag_invalid"}
_NUMBER_TYPES = {"float_type", "int_type", "int_from_float"}
_SPOKEN_BOOLEANS = {"yes", "no", "on", "off", "y", "n"}


class _Broken(NamedTuple):
    """A validation error with its location in the file.

    Attributes:
        loc: Keys and indices without pydantic's names of union members.
        parent: The model with the last key, if any.
        of_choice: Whether the value has the wrong type for one of several union members.
    """

    detail: ErrorDetails
    loc: Loc
    parent: type[BaseModel] | None
    of_choice: bool


def dotted(loc: Loc) -> str:
    """Return a location as a dotted key, list indices included."""
    return ".".join(map(str, loc))


def loc_of(key: str) -> Loc:
    """Return a dotted key as a location; numbers are list indices."""
    return tuple(int(part) if part.isdecimal() else part for part in key.split("."))


def broken_rules(
    error: ValidationError, model: type[BaseModel], where: Callable[[Loc], str], at: Loc = ()
) -> list[ConfigProblem]:
    """Return all validation errors of a file, one problem per value.

    ``where`` returns the ``file:line`` of a location, or of its nearest parent; ``at`` is the
    location of the model's data in the file.
    """
    problems: list[ConfigProblem] = []
    broken = [_located(model, detail) for detail in error.errors(include_url=False)]
    # Ignore type errors of union members if another member matched the type.
    meant = {
        each.loc[:n] for each in broken if not each.of_choice for n in range(len(each.loc) + 1)
    }
    groups: dict[Loc, list[_Broken]] = {}
    for index, each in enumerate(broken):
        cause = each.detail.get("ctx", {}).get("error")
        if isinstance(cause, ConfigError):  # from another file, with its own place
            problems += cause.problems
        elif not (each.of_choice and each.loc in meant):
            groups.setdefault(each.loc if each.of_choice else (index, *each.loc), []).append(each)
    return problems + [_problem(group, where, at) for group in groups.values()]


def _problem(group: list[_Broken], where: Callable[[Loc], str], at: Loc) -> ConfigProblem:
    first = group[0]
    place = loc = (*at, *first.loc)
    rule, *others = (_rule(each.detail) for each in group)
    rule = ", or ".join([rule, *(other.removeprefix("must be ") for other in others)])
    if first.detail["type"] == "value_error":  # a rule on several keys begins with the key
        place = (*loc, *loc_of(rule.split(" ", 1)[0]))
    known = first.parent.model_fields if first.parent else ()
    hint = next(filter(None, (_hint(each.detail, known) for each in group)), "")
    return ConfigProblem(where(place), dotted(loc), rule, _value(first.detail), hint)


def _rule(detail: ErrorDetails) -> str:
    kind = detail["type"]
    if kind in _RULES:
        return _RULES[kind].format(**detail.get("ctx", {}))
    if kind in _WORDS:
        expected = _expected(detail)
        several = " or " in expected or ", " in expected
        return f"must be one of {expected}" if several else f"must be {expected}"
    return detail["msg"][0].lower() + detail["msg"][1:]


def _expected(detail: ErrorDetails) -> str:
    context = detail.get("ctx", {})
    return str(context.get("expected") or context.get("expected_tags"))


def _value(detail: ErrorDetails) -> str:
    """Return the invalid value on one line; empty if the rule includes it."""
    value, kind = detail["input"], detail["type"]
    if kind in _WITHOUT_VALUE:
        return ""
    if kind == "union_tag_invalid":
        return repr(detail.get("ctx", {})["tag"])
    if value is None or isinstance(value, bool):
        return {None: "nothing", True: "true", False: "false"}[value]
    text = repr(list(value) if isinstance(value, tuple) else value)
    return text if len(text) <= 60 else text[:57] + "..."


def _hint(detail: ErrorDetails, known: Iterable[str]) -> str:
    value, kind = detail["input"], detail["type"]
    if kind == "extra_forbidden":
        return did_you_mean(str(detail["loc"][-1]), known)
    if kind in _WORDS:  # the rule lists all of them
        given, words = detail.get("ctx", {}).get("tag", value), _QUOTED.findall(_expected(detail))
        if given in words:  # written as Python does, so with an escape
            return f'write it in double quotes: "{given}"'
        return did_you_mean(str(given), words, listed=True) if len(words) > 1 else ""
    if kind in _NUMBER_TYPES and isinstance(value, str):
        return _number_hint(value)
    if kind in _NUMBER_TYPES and isinstance(value, float) and value.is_integer():
        return f"write {value:.0f}"
    if kind == "bool_type" and str(value).lower() in _SPOKEN_BOOLEANS:
        return "write true or false"
    if kind == "string_type" and isinstance(value, bool | int | float):
        return "put it in quotes"
    return ""


def odd_characters(lines: Sequence[str], number: int) -> str:
    """Return which invisible character a line, or the one before it, has; empty for none."""
    for at in range(max(0, number - 1), min(number + 1, len(lines))):
        for mark in lines[at]:
            if mark != " " and unicodedata.category(mark) in {"Zs", "Cf"}:
                called = f"U+{ord(mark):04X} ({unicodedata.name(mark, 'without a name')})"
                return f"line {at + 1} has the invisible character {called}: write a space"
    return ""


def _number_hint(text: str) -> str:
    if text[:1] in _DASHES:
        called = f"{unicodedata.name(text[0])} (U+{ord(text[0]):04X})"
        return f"write the minus of the keyboard instead of {called}"
    if _is_number(text):
        return "remove the quotes"
    if _is_number(point := text.replace(",", ".", 1)):
        return f"{point} or {text.replace(',', '')}? write a decimal point, or none"
    if text[:1] in set("+-.0123456789"):
        return "write a plain number, such as 1000, 0.5 or 1e-3"
    return ""


def _is_number(text: str) -> bool:
    return any(re.fullmatch(pattern, text) for pattern in NUMBERS.values())


def _located(model: type[BaseModel], detail: ErrorDetails) -> _Broken:
    """Map pydantic's location to the file, without its names of union members."""
    choices: list[Any] = [model]
    parent: type[BaseModel] | None = None
    plain: list[str | int] = []
    chose = False
    for part in detail["loc"]:
        chose = len(choices) > 1
        if chose:
            choices = [choice for choice in choices if _is_named(choice, part)]
        elif part != "[key]":
            plain.append(part)
            parent = choices[0] if choices and _is_model(choices[0]) else None
            choices = _choices(_inner(choices[0], part)) if choices else []
    kind = detail["type"]
    if kind == "union_tag_invalid":
        plain.append("kind")
    of_choice = chose and (kind == "literal_error" or kind.endswith("_type"))
    return _Broken(detail, tuple(plain), parent, of_choice)


def _is_model(annotation: Any) -> bool:
    return isinstance(annotation, type) and issubclass(annotation, BaseModel)


def _is_named(choice: Any, name: str | int) -> bool:
    """Return whether pydantic's name of a union member, its kind or class, matches.

    The class may be inside its validators: ``function-after[_fits(), Flag]``.
    """
    if not _is_model(choice):
        return False
    if re.search(rf"\b{choice.__name__}\]*$", str(name)):
        return True
    kind = choice.model_fields.get("kind")
    return kind is not None and name in typing.get_args(kind.annotation)


def _inner(annotation: Any, part: str | int) -> Any:
    """Return the type of the value at a key or index; None if unknown."""
    if _is_model(annotation):
        field = annotation.model_fields.get(part)
        return field.annotation if field else None
    origin, inner = typing.get_origin(annotation), typing.get_args(annotation)
    if origin in {dict, Mapping}:
        return inner[1]
    if origin is not tuple:
        return None
    if inner[-1] is Ellipsis:
        return inner[0]
    return inner[part] if isinstance(part, int) and part < len(inner) else None


def _choices(annotation: Any) -> list[Any]:
    """Return the union members of a type, or the type itself."""
    origin = typing.get_origin(annotation)
    if origin is Annotated:
        return _choices(typing.get_args(annotation)[0])
    if origin in {typing.Union, types.UnionType}:
        return [each for each in typing.get_args(annotation) if each is not type(None)]
    return [annotation]
