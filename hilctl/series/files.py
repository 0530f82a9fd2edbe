"""Figures of runs as files, in formats and widths of journals."""

from collections.abc import Callable, Sequence
from pathlib import Path

from matplotlib.figure import Figure

from hilctl.analysis.sheet import ColumnWidth, Sheet, drawn
from hilctl.analysis.vector import write_figure
from hilctl.base.errors import InputError
from hilctl.series.collect import OnRead, RunSeries
from hilctl.series.sheets import sheets_of


def write_sheets(
    series: RunSeries,
    folder: Path,
    formats: Sequence[str],
    width: ColumnWidth,
    *,
    overwrite: bool,
    on_done: OnRead = lambda done, text: None,
    on_drawn: Callable[[str, Figure], None] = lambda name, figure: None,
) -> dict[Path, str]:
    """Write all figures that apply to runs.

    Args:
        series: The runs.
        folder: Where they go; made where it is missing.
        formats: See :data:`hilctl.analysis.vector.FORMATS`.
        width: Of one column of a journal, or of two.
        overwrite: Whether files of these names may be replaced.
        on_done: Told of progress.
        on_drawn: Called with each figure and its name.

    Returns:
        The files, each with its caption.

    Raises:
        InputError: No figure applies, or a file exists or can't be written.
    """
    sheets = _applying(series)
    names = [folder / f"{sheet.name}.{each}" for sheet in sheets for each in formats]
    taken = [path for path in names if path.exists()]
    if taken and not overwrite:
        raise InputError(f"{taken[0]}: exists already: give another --output, or --overwrite")
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{folder}: can't be made: {error.strerror}") from None
    written: dict[Path, str] = {}
    for number, sheet in enumerate(sheets):
        on_done(number / len(sheets), f"draw {sheet.name}")
        figure = drawn(sheet, width)
        on_drawn(sheet.name, figure)
        paths = write_figure(figure, folder, sheet.name, formats, overwrite=overwrite)
        written |= dict.fromkeys(paths, sheet.caption)
    return written


def draw_sheets(
    series: RunSeries, width: ColumnWidth, on_done: OnRead = lambda done, text: None
) -> dict[str, Figure]:
    """Draw all figures that apply to runs; return them by their names.

    Args:
        series: The runs.
        width: Of one column of a journal, or of two.
        on_done: Told of progress.

    Raises:
        InputError: No figure applies.
    """
    figures = {}
    sheets = _applying(series)
    for number, sheet in enumerate(sheets):
        on_done(number / len(sheets), f"draw {sheet.name}")
        figures[sheet.name] = drawn(sheet, width)
    return figures


def _applying(series: RunSeries) -> list[Sheet]:
    sheets = sheets_of(series)
    if not sheets:
        raise InputError(f"{series.name}: no completed run holds what a figure could be drawn of")
    return sheets
