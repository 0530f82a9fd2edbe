"""A figure before its size is known: panels that are drawn into axes, for any column's width.

The widths are those of journals, and letters are as large in all of them. So one figure serves in
print, and on a page beside others, or below them on a phone.
"""

from collections.abc import Callable
from dataclasses import dataclass
from textwrap import wrap
from typing import Any, Literal, TypeAlias

import matplotlib as mpl
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from hilctl.analysis.plot_style import STYLE

ColumnWidth: TypeAlias = Literal["single", "double"]

COLUMN_MM: dict[ColumnWidth, float] = {"single": 85.0, "double": 175.0}
"""Widths of one and of two columns of most journals."""

_MM_PER_INCH = 25.4
_LEGEND_LINE_MM = 3.6
_SPARE_MM = 4.0
_CHARACTER_MM = 1.5  # of a letter, on the average
_HANDLE_MM = 9.0
_NAMES_MM = 14.0  # of an axis and its ticks, beside a title
_LEAST_MM = 48.0
_FEWEST_NAMED = 2  # what stands alone is named by its axes


@dataclass(frozen=True, slots=True)
class Panel:
    """One pair of axes.

    Attributes:
        draw: Draws into axes, and names them.
        title: What it shows; a letter comes before it where there are several.
        height: Of its width, in a column of its own.
    """

    draw: Callable[[Axes], None]
    title: str = ""
    height: float = 0.62


@dataclass(frozen=True, slots=True)
class FigureSpec:
    """A figure of one or more panels, with one legend below all of them.

    Attributes:
        name: Short name, of its file.
        caption: What it shows, for people.
        panels: The panels.
        alike: Whether panels have the same axes: then they stand two abreast in a single column,
            and only the outer ones are named.
        stacked: Whether they share the axis along and stand one below the other.
        most_beside: Most panels beside each other in two columns.
    """

    name: str
    caption: str
    panels: tuple[Panel, ...]
    alike: bool = False
    stacked: bool = False
    most_beside: int = 3


@mpl.rc_context(STYLE)
def drawn(sheet: FigureSpec, width: ColumnWidth = "single") -> Figure:
    """Draw a figure.

    Args:
        sheet: The figure.
        width: Of one column of a journal, or of two.
    """
    columns = _columns(sheet, width)
    rows = -(-len(sheet.panels) // columns)
    whole_mm = COLUMN_MM[width]
    heights_mm = [
        max(_height_mm(each, whole_mm / columns) for each in sheet.panels[start : start + columns])
        for start in range(0, len(sheet.panels), columns)
    ]
    figure = Figure(figsize=(whole_mm / _MM_PER_INCH, sum(heights_mm) / _MM_PER_INCH))
    grid = figure.subplots(
        rows,
        columns,
        squeeze=False,
        sharex="all" if sheet.alike else "col" if sheet.stacked else "none",
        sharey="all" if sheet.alike else "none",
        height_ratios=heights_mm,
    )
    for number, (axes, panel) in enumerate(zip(grid.flat, sheet.panels, strict=False)):
        panel.draw(axes)
        letter = f"({chr(ord('a') + number)}) " if len(sheet.panels) > 1 else ""
        characters = int((whole_mm / columns - _NAMES_MM) / _CHARACTER_MM)
        axes.set_title("\n".join(wrap(f"{letter}{panel.title}", characters)))
        if sheet.stacked and number + columns < len(sheet.panels):
            axes.set_xlabel("")
    for number, axes in enumerate(grid.flat[len(sheet.panels) :], len(sheet.panels)):
        axes.set_axis_off()
        above = grid.flat[number - columns]
        above.tick_params(labelbottom=True)
    if sheet.alike:
        _name_outer(grid, len(sheet.panels))
    _legend(figure, [axes for axes in grid.flat if axes.axison], whole_mm)
    if (layout := figure.get_layout_engine()) is not None:
        # Once, as it takes half the time of a figure: a file of each format would do it again.
        layout.execute(figure)
        figure.set_layout_engine("none")
    return figure


def _height_mm(panel: Panel, width_mm: float) -> float:
    """Return the height of a panel; a narrow one is not made flat, its ticks need the room."""
    highest_mm = panel.height * COLUMN_MM["single"]
    return min(max(panel.height * width_mm, _LEAST_MM), highest_mm) + _SPARE_MM


def _columns(sheet: FigureSpec, width: ColumnWidth) -> int:
    if sheet.stacked:
        return 1
    if width == "single":
        return 2 if sheet.alike and len(sheet.panels) > 2 else 1
    count = len(sheet.panels)
    return min(2 if count == 4 else count, sheet.most_beside)


def _name_outer(grid: Any, panels: int) -> None:
    """Leave names of axes only where no other panel of the same axes stands between."""
    rows, columns = grid.shape
    for row in range(rows):
        for column in range(columns):
            axes = grid[row, column]
            if column:
                axes.set_ylabel("")
            if (row + 1) * columns + column < panels:
                axes.set_xlabel("")


def _legend(figure: Figure, drawn_axes: list[Axes], whole_mm: float) -> None:
    """Name all that is drawn, once, below the panels; the figure grows by it."""
    entries: dict[str, Any] = {}
    for axes in drawn_axes:
        for handle, label in zip(*axes.get_legend_handles_labels(), strict=True):
            entries.setdefault(label, handle)
    if len(entries) < _FEWEST_NAMED:
        return
    longest = max(map(len, entries))
    columns = max(1, int(whole_mm / (_CHARACTER_MM * longest + _HANDLE_MM)))
    columns = min(columns, len(entries))
    lines = -(-len(entries) // columns)
    columns = -(-len(entries) // lines)
    wide, high = figure.get_size_inches()
    figure.set_size_inches(wide, high + (lines * _LEGEND_LINE_MM + 1.0) / _MM_PER_INCH)
    figure.legend(list(entries.values()), list(entries), loc="outside lower center", ncols=columns)
