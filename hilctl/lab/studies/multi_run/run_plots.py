"""Loops of runs side by side: by parameter, with and without a compensator, with a model."""

from collections.abc import Hashable, Iterator, Mapping, Sequence, Sized
from functools import partial
from itertools import cycle
from typing import Any, TypeAlias, TypeVar

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes

from hilctl.base.formatting import quantity
from hilctl.lab.pages.figure_layout import FigureSpec, Panel
from hilctl.lab.pages.plot_style import (
    DISPLACEMENT,
    NAMED,
    PALE,
    QUIET,
    REFERENCE,
    WITHOUT,
    of_range,
)  # fmt: skip
from hilctl.lab.studies.multi_run.collect import RunSeries, SeriesRun
from hilctl.lab.studies.multi_run.digest import RunDigest
from hilctl.lab.studies.multi_run.varied_parameter import (
    WITHOUT_COMPENSATOR,
    VariedParameter,
    rank_of,
    texts_of,
)

Item = TypeVar("Item")
Measured: TypeAlias = tuple[SeriesRun, RunDigest]

_SIGNS = ("o", "s", "^", "D", "v", "P", "X", "<", ">")
_MOST_CURVES = 7  # most distinguishable curves


def spread(items: Sequence[Item], most: int = _MOST_CURVES) -> list[Item]:
    """Return at most ``most`` evenly spread items of a sequence, including both ends."""
    if len(items) <= most:
        return list(items)
    return [items[k] for k in np.unique(np.linspace(0, len(items) - 1, most).round().astype(int))]


def looks(dimension: VariedParameter | None, values: Sequence[Hashable]) -> Mapping[Hashable, Any]:
    """Return colour and marker for each value of a parameter, or each name."""
    # viridis keeps its order in greyscale; names use the colours of Okabe and Ito.
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
    """Return one colour per name; one colour is reserved for runs without a compensator."""
    if WITHOUT_COMPENSATOR not in names:
        return [NAMED[k % len(NAMED)] for k in range(len(names))]
    others = cycle(colour for colour in NAMED if colour != WITHOUT)
    return [WITHOUT if name == WITHOUT_COMPENSATOR else next(others) for name in names]


_MOST_PANELS = 6
_SQUARE = 0.9
_DISPLACEMENT_AXIS = "displacement, µm"


def loop_sheets(series: RunSeries) -> Iterator[FigureSpec]:
    """Yield the loops against each numeric parameter, one panel per value of the others."""
    for along in series.dimensions:
        groups = _groups(series, along) if along.numeric else []
        name = f"loops_by_{along.name.replace(' ', '_')}"
        # One figure per input, because its panels share their axes.
        for axis in dict.fromkeys(_input_axis(runs[0][1]) for _, runs in groups):
            found = [each for each in groups if _input_axis(each[1][0][1]) == axis]
            panels = tuple(
                Panel(partial(_draw_loops, along=along, runs=runs), title, _SQUARE)
                for title, runs in spread(found, _MOST_PANELS)
            )
            loops = max((runs for _, runs in found), key=len)
            more = _part(panels, found, "shown") + _part(spread(loops), loops, "in each panel")
            caption = f"Average steady loops by {along.name}{more}."
            yield FigureSpec(name, caption, panels, alike=True)
            name = f"{name}_against_reference"


def _part(shown: Sized, whole: Sized, where: str) -> str:
    return f", {len(shown)} of {len(whole)} {where}" if len(shown) < len(whole) else ""


def _groups(series: RunSeries, along: VariedParameter) -> list[tuple[str, list[Measured]]]:
    """Return groups of runs that differ in one parameter only, with their common values."""
    others = [each for each in series.dimensions if each is not along]
    found: dict[tuple[Hashable, ...], dict[Hashable, Measured]] = {}
    for run, digest in series.measured:
        if digest.loop.size:
            values = tuple(run.values.get(each.key) for each in others)
            found.setdefault(values, {}).setdefault(run.values.get(along.key), (run, digest))
    held = {values: {e.key: v for e, v in zip(others, values, strict=True)} for values in found}
    groups = []
    for values in sorted(found, key=lambda values: rank_of(others, held[values])):
        runs = [found[values][value] for value in along.values if value in found[values]]
        if len(runs) > 1:
            groups.append((texts_of(others, held[values]), runs))
    return groups


def _input_axis(digest: RunDigest) -> str:
    return "reference, µm" if digest.compensated else f"command, {digest.command_unit}"


def _draw_loops(axes: Axes, along: VariedParameter, runs: Sequence[Measured]) -> None:
    shown = spread(runs)
    look = looks(along, spread(along.values))
    own = looks(along, [run.values[along.key] for run, _ in shown])
    for run, digest in shown:
        value = run.values[along.key]
        colour = (look.get(value) or own[value])["color"]
        axes.plot(*digest.loop, color=colour, linewidth=0.9, label=along.text(value))
        axes.set(xlabel=_input_axis(digest), ylabel=_DISPLACEMENT_AXIS)


def model_sheet(series: RunSeries) -> FigureSpec | None:
    """Return measured and modelled loops, with one panel per run, of a selection of many runs.

    None without models.
    """
    runs = [each for each in series.measured if each[1].modelled.size]
    panels = tuple(
        Panel(partial(_draw_model, digest=digest), series.text(run), _SQUARE)
        for run, digest in spread(runs, _MOST_PANELS)
    )
    more = f"; {len(panels)} of {len(runs)} runs" if len(panels) < len(runs) else ""
    caption = f"Measured and modelled loops{more}."
    return FigureSpec("model_against_measured", caption, panels, alike=True) if panels else None


def _draw_model(axes: Axes, digest: RunDigest) -> None:
    command, measured, modelled = digest.modelled
    axes.plot(command, measured, color=PALE, linewidth=2.2, label="measured")
    axes.plot(command, modelled, color=DISPLACEMENT, linewidth=0.9, label="model")
    axes.set(xlabel=f"command, {digest.command_unit}", ylabel=_DISPLACEMENT_AXIS)
    note(axes, f"error {quantity(digest.model_error_percent, '%')}")


def before_after_sheet(series: RunSeries) -> FigureSpec | None:
    """Return loops without and with each compensator, normalised to their range, or None."""
    # A perfect compensator gives a straight line from corner to corner.
    pairs = pairs_of(series)
    if not pairs:
        return None
    panels = tuple(
        Panel(partial(_draw_pair, before=before, after=after), title, _SQUARE)
        for title, before, after in spread(pairs, _MOST_PANELS)
    )
    caption = "Loops before and after compensation, normalised; dotted: no hysteresis."
    return FigureSpec("before_and_after", caption, panels, alike=True)


Pair = tuple[str, RunDigest, list[tuple[str, RunDigest]]]


def pairs_of(series: RunSeries) -> list[Pair]:
    """Return each run without a compensator, with the compensated runs of the same settings."""
    with_loop = [each for each in series.measured if each[1].loop.size]
    before = [each for each in with_loop if not each[1].compensated]
    after = [each for each in with_loop if each[1].compensated]
    others = [each for each in series.dimensions if not each.is_compensator]
    found = []
    for run, digest in before:
        same = [
            (_compensator(other), with_one)
            for other, with_one in after
            if all(run.values.get(e.key) == other.values.get(e.key) for e in others)
        ]
        if same:
            found.append((texts_of(others, run.values), digest, same))
    return found


def _compensator(run: SeriesRun) -> str:
    name = run.values.get("compensator")
    return str(name) if name not in {None, "none"} else "with compensator"


def _draw_pair(axes: Axes, before: RunDigest, after: Sequence[tuple[str, RunDigest]]) -> None:
    lines = [(WITHOUT_COMPENSATOR, before), *after]
    look = looks(None, [name for name, _ in lines])
    axes.plot([0, 100], [0, 100], color=REFERENCE, linestyle=":", linewidth=0.8)
    for name, digest in lines:
        axes.plot(*of_range(digest.loop), color=look[name]["color"], linewidth=0.9, label=name)
    axes.set(xlabel="input, % of its range", ylabel="displacement, % of its range")


def note(axes: Axes, text: str) -> None:
    """Write a text into the upper left corner."""
    axes.text(0.03, 0.97, text, transform=axes.transAxes, va="top", fontsize=7, color=QUIET)
