"""Which figures apply to runs, by what varied among them and what their recordings hold."""

from collections.abc import Iterator

from hilctl.analysis.sheet import Sheet
from hilctl.series import loop_sheets, response_sheets, trend_sheets
from hilctl.series.collect import RunSeries


def sheets_of(series: RunSeries) -> list[Sheet]:
    """Return the figures of runs, what a reader wants first in front."""
    return [sheet for sheet in _sheets(series) if sheet is not None]


def _sheets(series: RunSeries) -> Iterator[Sheet | None]:
    yield loop_sheets.before_after_sheet(series)
    yield trend_sheets.resonance_sheet(series)
    yield response_sheets.frequency_sheet(series)
    yield response_sheets.step_sheet(series)
    yield from trend_sheets.trend_sheets(series)
    yield from loop_sheets.loop_sheets(series)
    yield loop_sheets.minor_loop_sheet(series)
    yield loop_sheets.model_sheet(series)
    yield loop_sheets.error_sheet(series)
    yield trend_sheets.sensitivity_sheet(series)
    yield trend_sheets.order_sheet(series)
