"""Figures of runs as files, in formats and widths of journals."""

from collections.abc import Callable, Sequence
from pathlib import Path

from matplotlib.figure import Figure

from hilctl.analysis.sheet import ColumnWidth, Sheet, drawn
from hilctl.analysis.vector import write_figure
from hilctl.base.errors import InputError
from hilctl.base.files import already_there
from hilctl.series.collect import OnRead, RunSeries
from hilctl.series.sheets import sheets_of


def write_sheets(
    sheets: Sequence[Sheet],
    folder: Path,
    formats: Sequence[str],
    width: ColumnWidth,
    *,
    overwrite: bool,
    on_done: OnRead = lambda done, text: None,
    on_drawn: Callable[[str, Figure], None] = lambda name, figure: None,
) -> dict[Path, str]:
    """Write figures.

    Args:
        sheets: The figures.
        folder: Where they go; made where it is missing.
        formats: See :data:`hilctl.analysis.vector.FORMATS`.
        width: Of one column of a journal, or of two.
        overwrite: Whether files of these names may be replaced.
        on_done: Told of progress.
        on_drawn: Called with each figure and its name.

    Returns:
        The files, each with its caption.

    Raises:
        InputError: A file exists or can't be written.
    """
    names = [folder / f"{sheet.name}.{each}" for sheet in sheets for each in formats]
    taken = [path for path in names if path.exists()]
    if taken and not overwrite:
        raise already_there(taken[0], "give another --output, or --overwrite")
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
    sheets: Sequence[Sheet], width: ColumnWidth, on_done: OnRead = lambda done, text: None
) -> dict[str, Figure]:
    """Draw figures; return them by their names.

    Args:
        sheets: The figures.
        width: Of one column of a journal, or of two.
        on_done: Told of progress.
    """
    figures = {}
    for number, sheet in enumerate(sheets):
        on_done(number / len(sheets), f"draw {sheet.name}")
        figures[sheet.name] = drawn(sheet, width)
    return figures


def applying_sheets(series: RunSeries) -> list[Sheet]:
    """Return all figures that apply to runs.

    Raises:
        InputError: There is none.
    """
    sheets = sheets_of(series)
    if not sheets:
        raise InputError(f"{series.name}: no completed run holds what a figure could be drawn of")
    return sheets
