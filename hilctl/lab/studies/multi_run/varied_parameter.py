"""Varied parameters of runs, with their names and units."""

import json
import re
from collections.abc import Hashable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import PurePath
from typing import Any

from hilctl.base.formatting import significant, unit_text

_IGNORED = ("name", "description", "labels", "recording", "device.seed", "condition")
_NAMES = {
    "frequency_hz": ("frequency", "Hz"),
    "amplitude": ("amplitude", ""),
    "bias_a": ("bias current", "A"),
    "load_kg": ("load", "kg"),
    "compensator": ("compensator", ""),
    "waveform": ("waveform", ""),
    "kind": ("kind", ""),
    "sample_rate_hz": ("sample rate", "Hz"),
}
"""Name and unit for the last part of a key."""
_CHOICES = ("compensator", "waveform", "kind")
_FIRST = (*_CHOICES, "frequency_hz", "amplitude", "bias_a", "load_kg")
"""Last parts of keys, in order of importance."""
_UNITS = ("a", "v", "um", "hz", "s", "kg", "ohm", "k", "ms", "us")
_UNIT_NAMES = {"a": "A", "v": "V", "hz": "Hz", "k": "K", "ohm": "ohm"}
WITHOUT_COMPENSATOR = "without compensator"  # label of runs without a compensator
_COMPONENT = re.compile(r"\.components\.(\d+)\.")


@dataclass(frozen=True, slots=True)
class VariedParameter:
    """One varied parameter."""

    key: str  # dotted key of the experiment
    name: str
    unit: str  # its unit, or empty
    values: tuple[Hashable, ...]  # numbers in ascending order, others in the order of the runs

    @property
    def numeric(self) -> bool:
        """Whether its values are numbers."""
        return all(_is_number(value) for value in self.values)

    @property
    def axis(self) -> str:
        """Label of its axis, with the unit."""
        return f"{self.name}, {unit_text(self.unit)}" if self.unit else self.name

    @property
    def is_frequency(self) -> bool:
        """Whether it is a frequency."""
        return self.key.endswith("frequency_hz")

    @property
    def is_compensator(self) -> bool:
        """Whether it is the compensator."""
        return self.key.split(".")[0] == "compensator"

    def text(self, value: Hashable) -> str:
        """Return a value with its unit."""
        if _is_number(value):
            number = float(str(value))
            shown = f"{number:g}" if len(f"{number:g}") <= 6 else significant(number)
            return f"{shown} {unit_text(self.unit)}".rstrip()
        return WITHOUT_COMPENSATOR if self.is_compensator and value == "none" else str(value)


def texts_of(parameters: Iterable[VariedParameter], values: Mapping[str, Hashable]) -> str:
    """Return the values of parameters with their units, separated by commas."""
    known = [each for each in parameters if values.get(each.key) is not None]
    return ", ".join(each.text(values[each.key]) for each in known)


def rank_of(parameters: Iterable[VariedParameter], values: Mapping[str, Hashable]) -> list[int]:
    """Return the place of each parameter's value among its values; -1 without one."""
    return [
        each.values.index(values[each.key]) if values.get(each.key) in each.values else -1
        for each in parameters
    ]


def value_at(values: Mapping[str, Any], key: str) -> Hashable:
    """Return the value of a dotted key, as a number or short text; None without one."""
    found: Any = values
    for part in key.split("."):
        if isinstance(found, Mapping):
            found = found.get(part)
        elif isinstance(found, Sequence) and not isinstance(found, str) and part.isdecimal():
            found = found[int(part)] if int(part) < len(found) else None
        else:
            return None
    return short_value(found)


def short_value(value: Any) -> Hashable:
    """Return a value as a number or a short text."""
    if isinstance(value, Mapping):
        if "model" in value:
            return PurePath(str(value["model"])).stem
        if "kind" in value:
            return str(value["kind"]).replace("_", " ")
    if isinstance(value, Mapping | list | tuple):
        return json.dumps(value, ensure_ascii=False)
    if isinstance(value, int | float) and not isinstance(value, bool):
        return float(value)
    return None if value is None else str(value)


def plain_text(value: Hashable) -> str:
    """Return a short value as text without its unit; empty for None."""
    return "" if value is None else f"{value:g}" if isinstance(value, float) else str(value)


def keys_of(runs: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return the dotted keys in which experiments differ, in the order of the first one."""
    found: dict[str, None] = {}
    for run in runs:
        found |= dict.fromkeys(_leaves(run, ""))
    keys = [key for key in found if not key.startswith(_IGNORED)]
    return [key for key in keys if len({value_at(run, key) for run in runs}) > 1]


def _leaves(value: Any, at: str) -> Iterator[str]:
    if isinstance(value, Mapping) and not (at == "compensator" and "model" in value):
        for key, inner in value.items():
            yield from _leaves(inner, f"{at}.{key}" if at else str(key))
    elif isinstance(value, list | tuple) and any(isinstance(each, Mapping) for each in value):
        for number, inner in enumerate(value):
            yield from _leaves(inner, f"{at}.{number}")
    else:
        yield at


def dimensions(
    keys: Sequence[str], rows: Sequence[Mapping[str, Hashable]], unit: str = ""
) -> tuple[VariedParameter, ...]:
    """Return the varied parameters of rows of values, without keys that depend on others."""
    columns = {key: [row.get(key) for row in rows] for key in keys}
    varied = [key for key in keys if len(set(columns[key]) - {None}) > 1]
    kept: list[str] = []
    for key in sorted(varied, key=lambda key: (_rank(key), keys.index(key))):
        if not any(_follows(columns, key, other) for other in kept):
            kept.append(key)
    return tuple(_dimension(key, columns[key], unit) for key in kept)


def _rank(key: str) -> int:
    last = key.rsplit(".", maxsplit=1)[-1]
    return _FIRST.index(last) if last in _FIRST else len(_FIRST)


def _follows(columns: Mapping[str, list[Hashable]], key: str, other: str) -> bool:
    """Return whether a key depends on another one: it has one value for each of the other's."""
    # An important key with fewer values is independent: three frequencies, two amplitudes.
    pairs = set(zip(columns[other], columns[key], strict=True))
    values = len(set(columns[other]))
    if len(pairs) != values:
        return False
    alike = len(set(columns[key])) == values
    return alike or _rank(key) == len(_FIRST) or other.rsplit(".", maxsplit=1)[-1] in _CHOICES


def _dimension(key: str, column: Sequence[Hashable], unit: str) -> VariedParameter:
    values = tuple(dict.fromkeys(value for value in column if value is not None))
    if all(_is_number(value) for value in values):
        values = tuple(sorted(values, key=lambda value: float(str(value))))
    last = key.rsplit(".", maxsplit=1)[-1]
    name, own = _NAMES.get(last) or _by_suffix(last)
    component = _COMPONENT.search(key)
    if component is not None:
        name = f"{name} of sine {int(component[1]) + 1}"
    return VariedParameter(key, name, own or (unit if last == "amplitude" else ""), values)


def _by_suffix(last: str) -> tuple[str, str]:
    name, _, suffix = last.rpartition("_")
    if name and suffix in _UNITS:
        return name.replace("_", " "), _UNIT_NAMES.get(suffix, suffix)
    return last.replace("_", " "), ""


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)
