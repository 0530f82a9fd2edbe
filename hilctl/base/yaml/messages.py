"""Broken rules in words: where, key, rule, value, and what to do about it."""

import difflib
import re
import types
import typing
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Annotated, Any, TypeAlias

from pydantic import BaseModel, ValidationError
from pydantic_core import ErrorDetails

from hilctl.base.errors import ConfigError, Problem
from hilctl.base.yaml.plain import is_number

Loc: TypeAlias = tuple[str | int, ...]
"""Keys and list indices that lead to a value."""

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
_BOUNDS = {"greater_than": ("> ", "gt"), "greater_than_equal": (">= ", "ge"),
           "less_than": ("< ", "lt"), "less_than_equal": ("<= ", "le")}  # fmt: skip
_WITHOUT_VALUE = {"missing", "value_error", "extra_forbidden", "union_tag_not_found"}
_NUMBERS = {"float_type", "int_type", "int_from_float"}
_SPOKEN_BOOLEANS = {"yes", "no", "on", "off", "y", "n"}


def dotted(loc: Loc) -> str:
    """Return a location as a dotted key, list indices included."""
    return ".".join(str(part) for part in loc)


def loc_of(key: str) -> Loc:
    """Return a dotted key as a location; what looks like a number is a list index."""
    return tuple(int(part) if part.isdecimal() else part for part in key.split("."))


def broken_rules(
    error: ValidationError, model: type[BaseModel], where: Callable[[Loc], str], at: Loc = ()
) -> list[Problem]:
    """Return all that pydantic says of a file, one problem a value.

    Args:
        error: What pydantic says.
        model: What it tried to build.
        where: Gives the ``file:line`` of a location, or of the nearest thing around it.
        at: Where in the file the model's data stand.
    """
    details = error.errors(include_url=False)
    causes = [detail.get("ctx", {}).get("error") for detail in details]
    # What a validator has read from another file says for itself where it stands.
    elsewhere = [p for cause in causes if isinstance(cause, ConfigError) for p in cause.problems]
    broken = [
        located(model, detail)
        for detail, cause in zip(details, causes, strict=True)
        if not isinstance(cause, ConfigError)
    ]
    # A choice that was not meant says nothing, where another one says what is wrong within it.
    meant = {
        each.loc[:n] for each in broken if not each.of_choice for n in range(len(each.loc) + 1)
    }
    groups: dict[Loc, list[BrokenRule]] = {}
    for index, each in enumerate(broken):
        if not (each.of_choice and each.loc in meant):
            groups.setdefault(each.loc if each.of_choice else (index, *each.loc), []).append(each)
    return [*elsewhere, *(_problem(group, where, at) for group in groups.values())]


@dataclass(frozen=True, slots=True)
class BrokenRule:
    """One thing that pydantic says, with the keys that stand in the file.

    Attributes:
        detail: What it says.
        loc: Keys and indices, without pydantic's names of choices.
        parent: The model that the last key is in, where it is in one.
        of_choice: Whether a value is not of the type of one choice of several.
    """

    detail: ErrorDetails
    loc: Loc
    parent: type[BaseModel] | None
    of_choice: bool


def _problem(group: list[BrokenRule], where: Callable[[Loc], str], at: Loc) -> Problem:
    first = group[0]
    loc = (*at, *first.loc)
    rule = ", or ".join([_rule(first.detail), *(_choice(each.detail) for each in group[1:])])
    place = loc
    if first.detail["type"] == "value_error":  # a rule of several keys names the one it is about
        place = (*loc, *loc_of(rule.split(" ", 1)[0]))
    known = list(first.parent.model_fields) if first.parent else []
    hints = (_hint(each.detail, known) for each in group)
    hint = next(filter(None, hints), "")
    return Problem(where(place), dotted(loc), rule, _value(first.detail), hint)


def _choice(detail: ErrorDetails) -> str:
    return _rule(detail).removeprefix("must be ")


def did_you_mean(word: str, known: Iterable[str]) -> str:
    """Return a hint with the closest known name, or with all of them."""
    names = sorted(known)
    close = difflib.get_close_matches(word, names, n=1)
    if close:
        return f"did you mean '{close[0]}'?"
    return f"known: {', '.join(names)}" if names else ""


def _rule(detail: ErrorDetails) -> str:
    kind, context = detail["type"], detail.get("ctx", {})
    if kind in _RULES:
        return _RULES[kind]
    if kind == "value_error":
        return str(context["error"])
    if kind in _BOUNDS:
        sign, name = _BOUNDS[kind]
        return f"must be {sign}{context[name]}"
    if kind in {"literal_error", "union_tag_invalid"}:
        expected = str(context.get("expected") or context.get("expected_tags"))
        several = " or " in expected or ", " in expected
        return f"must be one of {expected}" if several else f"must be {expected}"
    if kind in {"too_short", "too_long"}:
        name = "at least" if kind == "too_short" else "at most"
        length = context.get("min_length", context.get("max_length"))
        return f"must have {name} {length} values"
    message = detail["msg"]
    return message[0].lower() + message[1:]


def _value(detail: ErrorDetails) -> str:
    """Return the offending value, short enough for one line; empty where the rule has it."""
    if detail["type"] == "union_tag_invalid":
        return repr(detail.get("ctx", {})["tag"])
    if detail["type"] in _WITHOUT_VALUE:
        return ""
    text = _as_written(detail["input"])
    return text if len(text) <= 60 else text[:57] + "..."


def _as_written(value: Any) -> str:
    if value is None or isinstance(value, bool):
        return {None: "nothing", True: "true", False: "false"}[value]
    return repr(list(value)) if isinstance(value, tuple) else repr(value)


def _hint(detail: ErrorDetails, known: Iterable[str]) -> str:
    value, kind = detail["input"], detail["type"]
    if kind == "extra_forbidden":
        return did_you_mean(str(detail["loc"][-1]), known)
    if kind in {"literal_error", "union_tag_invalid"}:
        return _word_hint(detail)
    if kind in _NUMBERS and isinstance(value, str):
        return _number_hint(value)
    if kind in _NUMBERS and isinstance(value, float) and value.is_integer():
        return f"write {value:.0f}"
    if kind == "bool_type" and str(value).lower() in _SPOKEN_BOOLEANS:
        return "write true or false"
    if kind == "string_type" and isinstance(value, bool | int | float):
        return "put it in quotes"
    return ""


def _word_hint(detail: ErrorDetails) -> str:
    """Return the word that is near, where one of a few was wanted: all of them are listed."""
    context = detail.get("ctx", {})
    given = context.get("tag", detail["input"])
    words = re.findall(r"'([^']+)'", str(context.get("expected") or context.get("expected_tags")))
    close = difflib.get_close_matches(str(given), words, n=1, cutoff=0.75)
    return f"did you mean '{close[0]}'?" if close and len(words) > 1 else ""


def _number_hint(text: str) -> str:
    if is_number(text):
        return "remove the quotes"
    if is_number(point := text.replace(",", ".", 1)):
        return f"{point} or {text.replace(',', '')}? write a decimal point, or none"
    if text[:1] in set("+-.0123456789"):
        return "write a plain number, such as 1000, 0.5 or 1e-3"
    return ""


def located(model: type[BaseModel], detail: ErrorDetails) -> BrokenRule:
    """Follow pydantic's location through the types, and leave out its names of choices."""
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
    return BrokenRule(detail, tuple(plain), parent, of_choice)


def _is_model(annotation: Any) -> bool:
    return isinstance(annotation, type) and issubclass(annotation, BaseModel)


def _is_named(choice: Any, name: str | int) -> bool:
    """Return whether pydantic calls a choice so: by its kind, or by its class.

    The class may stand within its validators: ``function-after[_fits(), Flag]``.
    """
    if not _is_model(choice):
        return False
    if re.search(rf"\b{choice.__name__}\]*$", str(name)):
        return True
    kind = choice.model_fields.get("kind")
    return kind is not None and name in typing.get_args(kind.annotation)


def _inner(annotation: Any, part: str | int) -> Any:
    """Return the type of what stands at a key or an index; None where it is not known."""
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
    """Return what a value may be: several types where pydantic's location names the choice."""
    origin = typing.get_origin(annotation)
    if origin is Annotated:
        return _choices(typing.get_args(annotation)[0])
    if origin in {typing.Union, types.UnionType}:
        return [each for each in typing.get_args(annotation) if each is not type(None)]
    return [annotation]
