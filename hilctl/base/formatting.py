"""Format numbers with units and printable texts for people, and JSON for programs."""

import difflib
import json
import math
from collections.abc import Iterable, Mapping, Sized
from dataclasses import fields
from html import escape
from pathlib import PurePath
from typing import Any, TypeVar

_DIGITS = 3
_SCALES: dict[str, tuple[tuple[float, str], ...]] = {
    "s": ((86400.0, "d"), (3600.0, "h"), (60.0, "min"), (1.0, "s"), (1e-3, "ms"), (1e-6, "µs"),
          (1e-9, "ns")),
    "us": ((1e6, "s"), (1e3, "ms"), (1.0, "µs"), (1e-3, "ns")),
    "um": ((1e3, "mm"), (1.0, "µm"), (1e-3, "nm")),
}  # fmt: skip
_SHOWN = {"um": "µm", "us": "µs", "um*um": "µm²", "ohm": "Ω", "degrees": "°"}
MISSING = "-"


def unit_text(unit: str) -> str:
    """Return a unit for display: ``um*A`` is µm·A."""
    if unit in _SHOWN:
        return _SHOWN[unit]
    for divider in "*/":
        if divider in unit:
            sign = "·" if divider == "*" else "/"
            return sign.join(unit_text(part) for part in unit.split(divider))
    return unit


def significant(value: float, digits: int = _DIGITS) -> str:
    """Return a number with significant digits including trailing zeros.

    Numbers of 1e6 and more, and those below 1e-4, have an exponent.
    """
    if value == 0.0:
        return "0"
    if not math.isfinite(value):
        return str(value)
    rounded = f"{value:.{digits - 1}e}"
    exponent = int(rounded.partition("e")[2])
    if not -5 < exponent < 6:
        return rounded
    return f"{float(rounded):.{max(0, digits - 1 - exponent)}f}"


def quantity(value: float | None, unit: str = "", digits: int = _DIGITS) -> str:
    """Return a value with its unit: 39910 us is 39.9 ms; a dash for None.

    The units s, us and um are scaled to a suitable multiple.
    """
    if value is None:
        return MISSING
    if unit in _SCALES and value != 0.0 and math.isfinite(value):
        rounded = abs(float(f"{value:.{digits - 1}e}"))
        scale, name = next(
            (each for each in _SCALES[unit] if rounded >= each[0]), _SCALES[unit][-1]
        )
        return f"{significant(value / scale, digits)} {name}"
    return f"{significant(value, digits)} {unit_text(unit)}".rstrip()


MOST_SHOWN = 100
"""Longest displayed name in characters."""


def printable(text: str, *, lines: bool = False) -> str:
    r"""Return a text with control characters and direction marks escaped (``\x1b``, ``\u202e``).

    Line ends and tabs are kept with ``lines``.
    """
    if text.isprintable():  # nearly always
        return text
    kept = "\n\t" if lines else ""
    return "".join(
        each if each.isprintable() or each in kept else each.encode("unicode_escape").decode()
        for each in text
    )


def encodable(text: str) -> str:
    r"""Return a text with half characters escaped (``\ud800``), which UTF-8 cannot encode."""
    return text.encode(errors="backslashreplace").decode()


def short_name(text: str) -> str:
    """Return a printable text of at most :data:`MOST_SHOWN` characters."""
    name = printable(text[: MOST_SHOWN + 1])
    return name if len(name) <= MOST_SHOWN else name[: MOST_SHOWN - 3] + "..."


_ALIKE = 0.8  # ratio of the common letters of two names, the rest being typing errors
_MOST_OFFERED = 3


def did_you_mean(word: str, known: Iterable[str], *, listed: bool = False) -> str:
    """Return a hint with the plausible names, or with all of them unless they are ``listed``."""
    names = sorted(known)
    close = difflib.get_close_matches(word, names, n=1, cutoff=_ALIKE)
    begun = [each for each in names if len(word) > 2 and each.startswith(word.lower())]
    offered = begun or close or [each for each in names if _is_plausible(word, each)]
    if 0 < len(offered) <= _MOST_OFFERED:
        return f"did you mean {' or '.join(map(repr, offered))}?"
    return "" if listed or not names else f"known: {', '.join(names)}"


def _is_plausible(word: str, name: str) -> bool:
    """Return whether two names have equal letters, or one begins or contains the other."""
    short, long = sorted((word.lower(), name.lower()), key=len)
    inside = f"_{short}_" in f"_{long}_" or long.startswith(short)
    return (inside and len(short) > 2) or sorted(short) == sorted(long)


def finite_json(value: Any, indent: int | None = None) -> str:
    """Return a value as JSON, with ``null`` for numbers that are not finite."""
    try:
        return json.dumps(value, indent=indent, allow_nan=False)
    except ValueError:
        return json.dumps(finite(value), indent=indent, allow_nan=False)


def finite(value: Any) -> Any:
    """Return plain values with None for numbers that JSON does not have."""
    if isinstance(value, Mapping):
        return {key: finite(each) for key, each in value.items()}
    if isinstance(value, list | tuple):
        return [finite(each) for each in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


_LONGEST = 60
_FEW = 3
Shown = TypeVar("Shown", bound=type)


def shown_briefly(kind: Shown) -> Shown:
    """Show the objects of a dataclass or a pydantic model in one line, in a notebook as a table.

    Arrays and nested objects are shown by type and size; None and empty values are omitted.
    """

    def text(self: Any) -> str:
        values = (f"{key}={value}" for key, value in _rows(self))
        return f"{type(self).__name__}({', '.join(values)})"

    def table(self: Any) -> str:
        rows = (f"<tr><th>{key}</th><td>{escape(value)}</td></tr>" for key, value in _rows(self))
        return f"<table><caption>{type(self).__name__}</caption>{''.join(rows)}</table>"

    changed: Any = kind
    changed.__repr__, changed._repr_html_ = text, table
    return kind


def _rows(shown: Any) -> list[tuple[str, str]]:
    names = getattr(type(shown), "model_fields", None) or [each.name for each in fields(shown)]
    values = ((name, getattr(shown, name)) for name in names)
    return [(name, _brief(value)) for name, value in values if not _is_empty(value)]


def _is_empty(value: object) -> bool:
    return value is None or (isinstance(value, Sized) and len(value) == 0)


def _brief(value: object) -> str:
    if value is None or isinstance(value, bool | int):
        return str(value)
    if isinstance(value, float):
        return f"{value:.6g}"
    if isinstance(value, str | PurePath):
        text = repr(str(value))
        return text if len(text) <= _LONGEST else f"{text[: _LONGEST - 4]}...'"
    if isinstance(value, tuple) and len(value) <= _FEW and all(isinstance(x, float) for x in value):
        return f"({', '.join(map(_brief, value))})"
    kind = type(value).__name__
    if shape := getattr(value, "shape", None):
        return f"<{kind} {list(shape)}>"
    return f"<{kind} of {len(value)}>" if isinstance(value, Sized) else f"<{kind}>"
