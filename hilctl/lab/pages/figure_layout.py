"""Figures of several panels: layout for the columns of journals and pages, and files.

Text has the same size in all widths, so that one figure serves in print and on a page.
"""

import io
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from textwrap import wrap
from typing import Any, BinaryIO, Literal, TypeAlias

import matplotlib as mpl
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from hilctl.base.errors import InputError
from hilctl.base.files import write_file
from hilctl.lab.pages.plot_style import STYLE

ColumnWidth: TypeAlias = Literal["single", "double"]

COLUMN_MM: dict[ColumnWidth, float] = {"single": 85.0, "double": 175.0}
"""Widths of one and of two columns of most journals."""

FORMATS = ("svg", "pdf", "png")
"""Formats of files, the vectors first."""
UNDATED_SVG: dict[str, Any] = {"Date": None, "Creator": None, "Format": None, "Type": None}
"""Metadata that makes the bytes of equal figures equal."""

_DPI = 600  # resolution of PNG files, as journals require for line drawings
_UNDATED: dict[str, Any] = {
    "svg": UNDATED_SVG,
    "pdf": {"CreationDate": None},
    "png": {"Software": None},
}
_MM_PER_INCH = 25.4
_LEGEND_LINE_MM = 3.6
_SPARE_MM = 4.0
_CHARACTER_MM = 1.5  # average width
_HANDLE_MM = 9.0
_NAMES_MM = 14.0  # width of an axis and its ticks, beside a title
_LEAST_MM = 48.0
_FEWEST_NAMED = 2  # a single line is named by its axes


@dataclass(frozen=True, slots=True)
class Panel:
    """One pair of axes, drawn and labelled by a function."""

    draw: Callable[[Axes], None]
    title: str = ""  # prefixed by a letter if there are several panels
    height: float = 0.62  # of its width, in a column of its own


@dataclass(frozen=True, slots=True)
class FigureSpec:
    """A figure of one or more panels, with one legend below all of them.

    Panels that are ``alike`` have the same axes: then a single column has two side by side, and
    only the outer axes have labels.
    """

    name: str  # name of its file
    caption: str
    panels: tuple[Panel, ...]
    alike: bool = False
    stacked: bool = False  # whether panels share the x axis, one below the other


@mpl.rc_context(STYLE)
def drawn(sheet: FigureSpec, width: ColumnWidth = "single") -> Figure:
    """Draw a figure for one or two columns of a journal."""
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
        grid.flat[number - columns].tick_params(labelbottom=True)
    if sheet.alike:  # name the outer axes only
        for number, axes in enumerate(grid.flat):
            if number % columns:
                axes.set_ylabel("")
            if number + columns < len(sheet.panels):
                axes.set_xlabel("")
    _legend(figure, [axes for axes in grid.flat if axes.axison], whole_mm)
    if (layout := figure.get_layout_engine()) is not None:
        # Once for all formats, because it takes half the time of a figure.
        layout.execute(figure)
        figure.set_layout_engine("none")
    return figure


def _height_mm(panel: Panel, width_mm: float) -> float:
    """Return the height of a panel; ticks need a minimum in a narrow one."""
    highest_mm = panel.height * COLUMN_MM["single"]
    return min(max(panel.height * width_mm, _LEAST_MM), highest_mm) + _SPARE_MM


def _columns(sheet: FigureSpec, width: ColumnWidth) -> int:
    if sheet.stacked:
        return 1
    if width == "single":
        return 2 if sheet.alike and len(sheet.panels) > 2 else 1
    count = len(sheet.panels)
    return min(2 if count == 4 else count, 3)


def _legend(figure: Figure, drawn_axes: list[Axes], whole_mm: float) -> None:
    """Add one legend below the panels; the figure grows."""
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


def formats_of(text: str) -> tuple[str, ...]:
    """Return the formats of a list such as ``svg,pdf``; raise InputError if one is unknown."""
    chosen = tuple(part.strip().lower() for part in text.split(",") if part.strip())
    unknown = [each for each in chosen if each not in FORMATS]
    if unknown or not chosen:
        got = ", ".join(unknown) or repr(text)
        raise InputError(f"--format: must be {', '.join(FORMATS)}, separated by commas (got {got})")
    return tuple(dict.fromkeys(chosen))


def write_figure(
    figure: Figure, folder: Path, name: str, formats: Sequence[str], *, overwrite: bool
) -> list[Path]:
    """Write a figure atomically as ``NAME.FORMAT`` in several formats; return the files.

    Raise InputError if a file exists and may not be replaced, or cannot be written.
    """
    written = []
    for chosen in formats:
        path = folder / f"{name}.{chosen}"
        write_file(path, partial(_write, figure, chosen), overwrite=overwrite)
        written.append(path)
    return written


@mpl.rc_context(STYLE)
def _write(figure: Figure, chosen: str, stream: BinaryIO) -> None:
    drawing = io.BytesIO()  # on a full disk, the PDF writer would end in an error of its own
    figure.savefig(drawing, format=chosen, dpi=_DPI, metadata=_UNDATED[chosen])
    stream.write(drawing.getbuffer())
