"""How runs are told apart in figures: colours in order, signs, and which of many are shown."""

from collections.abc import Hashable, Mapping, Sequence
from itertools import cycle
from typing import Any, TypeVar

import matplotlib as mpl
import numpy as np

from hilctl.analysis.plot_style import ERROR, MARK, QUIET, REFERENCE, WITH, WITHOUT
from hilctl.studies.multi_run.varied_parameter import WITHOUT_COMPENSATOR, VariedParameter

Item = TypeVar("Item")

_SIGNS = ("o", "s", "^", "D", "v", "P", "X", "<", ">")
_LINES = ("-", "--", "-.", ":")
_NAMED = (WITH, WITHOUT, ERROR, MARK, "#E69F00", "#56B4E9", REFERENCE, QUIET)
_MOST_CURVES = 7
"""More loops than that can't be told apart."""


def spread(items: Sequence[Item], most: int = _MOST_CURVES) -> list[Item]:
    """Return at most so many of a sequence, its ends among them, evenly spread."""
    if len(items) <= most:
        return list(items)
    return [items[k] for k in np.unique(np.linspace(0, len(items) - 1, most).round().astype(int))]


def looks(dimension: VariedParameter | None, values: Sequence[Hashable]) -> Mapping[Hashable, Any]:
    """Return how a line of each value is drawn.

    Numbers go through viridis, which keeps its order in grey and for colour-blind people; names
    have colours of Okabe and Ito. Signs differ too.

    Args:
        dimension: What the values are of; None where they are names.
        values: The values.
    """
    if dimension is not None and dimension.numeric and len(values) > 1:
        shades = mpl.colormaps["viridis"](np.linspace(0.0, 0.78, len(values)))
        colours = [mpl.colors.to_hex(shade) for shade in shades]
    else:
        names = [value if dimension is None else dimension.text(value) for value in values]
        colours = _of_names(names)
    return {
        value: {"color": colour, "marker": _SIGNS[k % len(_SIGNS)]}
        for k, (value, colour) in enumerate(zip(values, colours, strict=True))
    }


def _of_names(names: Sequence[Hashable]) -> list[str]:
    """Return a colour a name; runs without a compensator have theirs, and no other has it then."""
    if WITHOUT_COMPENSATOR not in names:
        return [_NAMED[k % len(_NAMED)] for k in range(len(names))]
    others = cycle(colour for colour in _NAMED if colour != WITHOUT)
    return [WITHOUT if name == WITHOUT_COMPENSATOR else next(others) for name in names]


def line_of(look: Mapping[str, Any], number: int = 0) -> dict[str, Any]:
    """Return a look without its sign, for a long line, dashed otherwise by its number."""
    return {"color": look["color"], "linestyle": _LINES[number % len(_LINES)]}
