"""A report for people: rows of text, and a compact table of them for a terminal."""

from collections.abc import Sequence

from rich.console import Group
from rich.table import Table
from rich.text import Text

from hilctl.analysis.figures import RunReport, SegmentReport

MISSING = "-"
SIMULATED = "simulated: no hardware was driven"

_SEGMENT_HEADINGS = (
    "segment",
    "start s",
    "freq. Hz",
    "cycles",
    "p-p um",
    "peak hyst. %",
    "floor %",
    "peak err. %",
    "rms err. %",
    "loop area",
)
_PAGE_ONLY = {"cycles", "start s", "freq. Hz", "floor %", "loop area"}  # a terminal has 80 columns


def number(value: float | None, unit: str = "") -> str:
    """Return a number with four digits and its unit; a dash for None."""
    if value is None:
        return MISSING
    return f"{value:.4g} {unit}".rstrip()


def run_rows(report: RunReport) -> list[tuple[str, str]]:
    """Return name and value of what the run was and how it ended."""
    simulated = f" ({SIMULATED})" if report.simulated else ""
    held_against = "reference" if report.compensated else "command: nothing compensated"
    return [
        ("device", f"{report.device or MISSING}{simulated}"),
        ("ended", f"{report.reason or MISSING}{'' if report.complete else ' (NOT complete)'}"),
        ("samples", f"{report.samples:,} of the waveform, {report.ramp_samples:,} of the ramp out"),
        ("missing samples", f"{report.dropped:,}"),
        ("rate, length", f"{report.sample_rate_hz:g} Hz, {report.duration_s:.6g} s"),
        ("loop", f"displacement against {held_against}"),
        ("command", _range(report.command_min, report.command_max, report.command_unit)),
        ("displacement", _range(report.displacement_min_um, report.displacement_max_um, "um")),
        ("limited samples", f"{report.limited_samples:,}"),
        ("invalid readings", f"{report.sensor_invalid_samples:,}"),
        ("ticks", f"{_count(report.late_ticks)} late, {_count(report.skipped_ticks)} skipped"),
        ("lateness", _percentiles(report.lateness_us)),
        ("exchange", _percentiles(report.exchange_us)),
    ]


def quality_rows(report: RunReport) -> list[tuple[str, str]]:
    """Return name and value of the figures of quality; the noise floor beside the hysteresis."""
    floor = number(report.noise_floor_percent, "%")
    raw = f"{number(report.peak_error_raw_percent, '%')} peak, "
    raw += f"{number(report.rms_error_raw_percent, '%')} rms"
    rows = [
        ("peak hysteresis", f"{number(report.peak_hysteresis_percent, '%')} (noise floor {floor})"),
        ("loop area", number(report.loop_area, report.loop_area_unit)),
        ("peak-to-peak", number(report.peak_to_peak_um, "um")),
        ("peak error", number(report.peak_error_percent, "%")),
        ("rms error", number(report.rms_error_percent, "%")),
        ("error, not averaged", raw),
        ("sensor noise", _nanometres(report.sensor_noise_um)),
        ("steady cycles", f"{report.steady_cycles:,}"),
        ("steady samples", f"{report.steady_samples:,}"),
    ]
    return rows if report.compensated else [row for row in rows if "error" not in row[0]]


def segment_table(report: RunReport) -> tuple[list[str], list[list[str]]]:
    """Return headings and rows of all segments, without columns that are empty in all of them."""
    columns = zip(*(_segment_cells(segment) for segment in report.segments), strict=True)
    filled = [
        (heading, column)
        for heading, column in zip(_SEGMENT_HEADINGS, columns, strict=False)
        if set(column) != {MISSING}
    ]
    rows = zip(*(column for _, column in filled), strict=True)
    return [heading for heading, _ in filled], [list(row) for row in rows]


def _segment_cells(segment: SegmentReport) -> list[str]:
    return [
        segment.label,
        number(segment.start_s),
        number(segment.frequency_hz),
        str(segment.steady_cycles),
        number(segment.peak_to_peak_um),
        number(segment.peak_hysteresis_percent),
        number(segment.noise_floor_percent),
        number(segment.peak_error_percent),
        number(segment.rms_error_percent),
        number(segment.loop_area),
    ]


def render(report: RunReport) -> Group:
    """Return a report as tables for a terminal; that of the segments where there are several."""
    title = report.name or "run"
    quality = _two_columns(title, quality_rows(report))
    parts = [quality, _two_columns("", run_rows(report))]
    if len(report.segments) > 1:
        parts.append(_segments(report))
    if len(report.lateness_by_minute) > 1:
        parts.append(_minutes(report))
    return Group(*parts)


def _two_columns(title: str, rows: Sequence[tuple[str, str]]) -> Table:
    # Text, not str: names and labels come from files and must not be read as markup.
    table = Table(title=Text(title) if title else None, show_header=False, title_justify="left")
    table.add_column(style="bold", no_wrap=True)
    table.add_column(overflow="fold")
    for name, value in rows:
        table.add_row(Text(name), Text(value))
    return table


def _segments(report: RunReport) -> Table:
    table = Table(title="by segment, worst above", title_justify="left")
    headings, rows = segment_table(report)
    shown = [i for i, heading in enumerate(headings) if heading not in _PAGE_ONLY]
    for i in shown:
        table.add_column(headings[i], justify="right" if i else "left", no_wrap=True)
    for cells in rows:
        table.add_row(*(Text(cells[i]) for i in shown))
    return table


def _minutes(report: RunReport) -> Table:
    table = Table(title="lateness by minute, us", title_justify="left")
    for heading in report.lateness_by_minute[0]:
        table.add_column(heading, justify="right", no_wrap=True)
    for minute in report.lateness_by_minute:
        table.add_row(*(f"{value:.4g}" for value in minute.values()))
    return table


def _range(low: float | None, high: float | None, unit: str) -> str:
    return MISSING if low is None else f"{number(low)} to {number(high, unit)}"


def _count(value: int | None) -> str:
    return MISSING if value is None else f"{value:,}"


def _nanometres(noise_um: float | None) -> str:
    return number(None if noise_um is None else noise_um * 1e3, "nm rms")


def _percentiles(figures: dict[str, float]) -> str:
    if not figures:
        return MISSING
    return ", ".join(f"{name} {value:.4g}" for name, value in figures.items()) + " us"
