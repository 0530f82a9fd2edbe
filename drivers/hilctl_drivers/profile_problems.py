"""YAML in without its traps, and broken rules in words."""

import difflib
import re
from collections.abc import Iterable, Iterator, Sequence
from typing import Any

import yaml
from pydantic import ValidationError
from pydantic_core import ErrorDetails

from hilctl.base.errors import Problem

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
_MAPPING = {"dict_type", "model_type", "model_attributes_type"}
_BOUNDS = {"greater_than": ("> ", "gt"), "greater_than_equal": (">= ", "ge"),
           "less_than": ("< ", "lt"), "less_than_equal": ("<= ", "le")}  # fmt: skip


class _Loader(yaml.SafeLoader):
    """Refuses what YAML 1.1 reads as something else than it looks like."""

    def construct_mapping(self, node: Any, deep: bool = False) -> dict[Any, Any]:
        seen: set[str] = set()
        for key, _ in node.value:
            if key.value in seen:
                raise yaml.constructor.ConstructorError(
                    None, None, f"key '{key.value}' stands twice", key.start_mark
                )
            seen.add(key.value)
        return super().construct_mapping(node, deep=deep)

    def construct_yaml_int(self, node: Any) -> int:
        text = node.value.replace("_", "").lstrip("+-")
        if ":" in text or re.fullmatch(r"0[0-9]+", text):
            raise yaml.constructor.ConstructorError(
                None,
                None,
                f"YAML reads {node.value} in base {60 if ':' in text else 8}: write a plain number",
                node.start_mark,
            )
        value: int = super().construct_yaml_int(node)
        return value


_Loader.add_constructor("tag:yaml.org,2002:int", _Loader.construct_yaml_int)


def read_yaml(text: str) -> Any:
    """Return a YAML text's content, lists as tuples.

    Raises:
        yaml.YAMLError: It is not YAML, holds a key twice, or a number with a leading zero.
        ValueError: It holds a value that Python can't, such as the 31st of February.
    """
    return _frozen(yaml.load(text, Loader=_Loader))  # noqa: S506  a SafeLoader


def _frozen(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _frozen(inner) for key, inner in value.items()}
    return tuple(map(_frozen, value)) if isinstance(value, list) else value


def value_at(data: Any, keys: Iterable[str]) -> Any:
    """Return what stands at a dotted key's parts; None where there is nothing."""
    for key in keys:
        if isinstance(data, dict):
            data = data.get(key)
        elif isinstance(data, tuple) and key.isdigit() and int(key) < len(data):
            data = data[int(key)]
        else:
            return None
    return data


def rules_broken(
    error: ValidationError, data: Any, where: str, known: Iterable[str]
) -> list[Problem]:
    """Return all broken rules with their keys as they stand in the file.

    Args:
        error: What pydantic says.
        data: What it was said of.
        where: The file, as it should appear in messages.
        known: Names of keys, for guessing what an unknown one should have been.
    """
    names = sorted(known)
    found = [
        (".".join(_keys(detail["loc"], data, detail["type"])), detail)
        for detail in error.errors(include_url=False)
        if not _beside_the_point(detail)
    ]
    mappings = {key for key, detail in found if detail["type"] in _MAPPING}
    words = {key for key, detail in found if detail["type"] == "literal_error"}
    problems: dict[str, Problem] = {}
    for key, detail in found:
        rule, value, hint = _rule(detail), _value(detail), _hint(detail, names)
        if key in mappings & words:
            if detail["type"] in _MAPPING:
                continue
            rule += ", or a mapping of keys to values"
        problems.setdefault(f"{key} {rule}", Problem(where, key, rule, value, hint))
    return list(problems.values())


def _keys(loc: Sequence[str | int], data: Any, kind: str) -> Iterator[str]:
    """Yield the parts of a location that are keys in the file; others name a union's choice."""
    for index, part in enumerate(loc):
        last = index == len(loc) - 1
        if isinstance(data, dict) and part in data:
            data = data[part]
        elif isinstance(data, tuple) and isinstance(part, int):
            data = data[part] if part < len(data) else None
        elif not (last and kind == "missing"):
            continue
        yield str(part)


def _beside_the_point(detail: ErrorDetails) -> bool:
    """Return whether this is the choice of a union that was not meant: a word, or a mapping."""
    mapping = isinstance(detail["input"], dict)
    choices = [
        part for part in detail["loc"] if isinstance(part, str) and part.startswith("literal[")
    ]
    return bool(choices) and mapping


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
        return f"must be one of {context.get('expected') or context.get('expected_tags')}"
    message = detail["msg"]
    return message[0].lower() + message[1:]


def _value(detail: ErrorDetails) -> str:
    if detail["type"] in _WITHOUT_VALUE:
        return ""
    value = detail["input"]
    text = "nothing" if value is None else repr(value)
    return text if len(text) <= 60 else text[:57] + "..."


def _hint(detail: ErrorDetails, known: list[str]) -> str:
    value = detail["input"]
    if detail["type"] == "extra_forbidden":
        close = difflib.get_close_matches(str(detail["loc"][-1]), known, n=1)
        return f"did you mean '{close[0]}'?" if close else ""
    if isinstance(value, bool):
        return "YAML reads yes, no, on and off as true and false: quote a text"
    if isinstance(value, str) and detail["type"] in {"float_type", "int_type"}:
        if re.fullmatch(r"[+-]?\d+(\.\d*)?[eE]\d+|[+-]?\d+[eE][+-]?\d+", value):
            return f"YAML reads this as text: write {float(value)!r}"
        return "remove the quotes" if re.fullmatch(r"[+-]?[\d.]+", value) else ""
    return ""
