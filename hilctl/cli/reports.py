"""Commands that evaluate recordings: report, figures, replay."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer
from rich.console import Group
from rich.table import Table
from rich.text import Text

from hilctl import api
from hilctl.analysis.contour import (
    ContourReport,
    contour_rows,
    contour_table,
    recordings_by_axis,
)
from hilctl.analysis.run_metrics import RunReport, quality_rows, run_rows, segment_table
from hilctl.base.errors import InputError
from hilctl.base.files import is_folder
from hilctl.base.formatting import printable, quantity
from hilctl.cli.console import console, print_rich, progress_bar, table
from hilctl.cli.options import (
    AsJson,
    FromTime,
    HtmlPage,
    Overwrite,
    RecordingFile,
    ToTime,
    recording_paths,
    recordings_argument,
)
from hilctl.cli.output import print_result
from hilctl.run.control.client import finish_dead_runs

if TYPE_CHECKING:
    from hilctl.analysis.replay import ReplayResult
    from hilctl.lab.studies.multi_run.collect import RunSeries

RunsInput = Annotated[list[Path], recordings_argument("Recordings (MCAP), or a campaign folder.")]
OtherModel = Annotated[
    Path | None,
    typer.Option(help="Model to compare with measured loops; default: the recorded one."),
]
FOLDER = "figures"
"""Default folder for figures, within the folder of the runs or the working folder."""

_MOST_MINUTES = 20
_COUNTS = {"minute", "ticks"}
_PAGE_ONLY = {"cycles", "start s", "freq. Hz", "floor %", "loop area"}  # a terminal has 80 columns


def report(
    runs: RunsInput,
    html: HtmlPage = None,
    before: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Recording of the same motion without compensator, for the page.",
            autocompletion=recording_paths,
        ),
    ] = None,
    model: OtherModel = None,
    from_s: FromTime = None,
    to_s: ToTime = None,
    overwrite: Overwrite = False,
    as_json: AsJson = False,
) -> None:
    """Evaluate recordings or a campaign: hysteresis, error, noise, lateness."""
    finish_dead_runs()
    if recordings_by_axis(runs):
        if before is not None or model is not None:
            raise InputError("--before and --model do not apply to a run of several axes")
        found = api.contour(runs, html, from_s=from_s, to_s=to_s, overwrite=overwrite)
        print_result(found.to_mapping(), lambda: print_rich(render_contour(found)), as_json=as_json)
        return
    if len(runs) > 1 or is_folder(runs[0]):
        if from_s is not None or to_s is not None or before is not None:
            raise InputError("--from, --to and --before apply to the report of one recording only")
        _report_many(runs, html, model, overwrite=overwrite, as_json=as_json)
        return
    if model is not None:
        raise InputError("--model applies to the report of several recordings only")
    if before is not None and html is None:
        raise InputError("--before needs a page to draw on: add --html FILE")
    if html is None:
        summary = api.summarize(runs[0], from_s=from_s, to_s=to_s)
    else:
        summary = api.report_page(
            runs[0], html, before=before, from_s=from_s, to_s=to_s, overwrite=overwrite
        )
    values = summary.to_mapping()
    print_result(values, lambda: print_rich(render_report(summary)), as_json=as_json)


def _report_many(
    runs: list[Path], html: Path | None, model: Path | None, *, overwrite: bool, as_json: bool
) -> None:
    with progress_bar("read", quiet=as_json) as on_progress:
        series = api.report_runs(
            runs, html, model=model, overwrite=overwrite, on_progress=on_progress
        )
    from hilctl.lab.studies.multi_run.multi_run_page import series_mapping  # matplotlib

    values = series_mapping(series)
    print_result(values, lambda: print_rich(render_series(series)), as_json=as_json)


def replay(
    recording: RecordingFile,
    model: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Model to replay with instead of the recorded one."),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Recompute commands from the recorded reference and compare them bit for bit."""
    finish_dead_runs()
    result = api.replay(recording, model)
    print_result(result.to_mapping(), lambda: print_replay(result, other=model), as_json=as_json)
    if model is None and not result.identical:
        raise typer.Exit(1)


def figures(
    runs: RunsInput,
    output: Annotated[
        Path | None,
        typer.Option(help=f"Folder for the figures; default: {FOLDER}, in the folder of the runs."),
    ] = None,
    formats: Annotated[
        str, typer.Option("--format", help="svg, pdf or png; separate several by commas.")
    ] = "svg,pdf,png",
    width: Annotated[
        Literal["single", "double"],
        typer.Option(help="Width of one journal column (85 mm) or two (175 mm)."),
    ] = "double",
    model: OtherModel = None,
    overwrite: Overwrite = False,
    as_json: AsJson = False,
) -> None:
    """Plot the results of runs by what was varied: loops, trends, errors."""
    folder = output or (runs[0] / FOLDER if is_folder(runs[0]) else Path(FOLDER))
    written: dict[Path, str] = {}
    with progress_bar("figures", quiet=as_json) as on_progress:
        api.figures(
            runs, folder, formats=formats, width=width, model=model, overwrite=overwrite,
            on_progress=on_progress, on_written=written.__setitem__,
        )  # fmt: skip
    captions = {str(path): caption for path, caption in written.items()}
    lines = "\n".join(f"{path}: {caption}" for path, caption in captions.items())
    print_result({"figures": captions}, lambda: print(lines), as_json=as_json)


def render_contour(report: ContourReport) -> Group:
    """Return the tables of a run of several axes: contour error, segments, and each axis."""
    parts = [_two_columns("contour", contour_rows(report))]
    if len(report.segments) > 1:
        parts.append(table("segments", *contour_table(report)))
    axes = (render_report(each, f"axis {name}") for name, each in report.axes.items())
    return Group(*parts, *axes)


def render_report(report: RunReport, title: str = "") -> Group:
    """Return the tables of a report; the segments have their own if there are several."""
    rows, (headings, cells) = run_rows(report), segment_table(report)
    title = title or printable(report.name) or "run"
    parts = [_two_columns(title, rows)]
    if quality := quality_rows(report):
        parts = [_two_columns(title, quality), _two_columns("", rows)]
    if len(cells) > 1:
        shown = [i for i, heading in enumerate(headings) if heading not in _PAGE_ONLY]
        cells = [[row[i] for i in shown] for row in cells]
        parts.append(table("segments, worst first", [headings[i] for i in shown], cells))
    if len(report.lateness_by_minute) > 1:
        parts.append(_minutes(report))
    return Group(*parts)


def _two_columns(title: str, rows: Sequence[tuple[str, str]]) -> Table:
    made = table(title, ("", ""), rows, left={""}, wrap=True)
    made.show_header, made.columns[0].style, made.columns[0].no_wrap = False, "bold", True
    return made


def _minutes(report: RunReport) -> Table:
    minutes, title = report.lateness_by_minute, "lateness per minute, µs"
    if len(minutes) > _MOST_MINUTES:  # --json contains all of them
        title += f": worst {_MOST_MINUTES} of {len(minutes)}"
        worst = sorted(minutes, key=lambda each: -each["max"])[:_MOST_MINUTES]
        minutes = sorted(worst, key=lambda each: each["minute"])
    rows = [
        [f"{v:,}" if name in _COUNTS else f"{v:.4g}" for name, v in minute.items()]
        for minute in minutes
    ]
    return table(title, [*minutes[0]], rows)


def render_series(series: "RunSeries") -> Group:
    """Return the summary of several runs and a table of them."""
    from hilctl.lab.studies.multi_run.multi_run_page import MOST_ROWS, run_table  # matplotlib

    headings, rows = run_table(series, MOST_ROWS, short=True)
    cells = [[printable(cell) for cell in row] for row in rows]
    runs = table(printable(series.name), headings, cells, left={"result"}, wrap=True)
    problems = [Text(f"not read: {printable(each)}", "red") for each in series.missing]
    named = [] if series.is_campaign else [(run.number, run.recording) for run in series.runs]
    files = [Text(f"{number}: {printable(name)}") for number, name in named]
    return Group(Text(printable(series.headline)), *problems, runs, *files)


def print_replay(result: "ReplayResult", *, other: Path | None) -> None:
    """Print the differences between recomputed and recorded commands."""
    show, unit = console().print, result.command_unit
    if result.left_out_samples:
        show(f"{result.left_out_samples} samples after a gap cannot be replayed")
    if other is None and result.identical:
        show(Text("identical", "green") + f": {result.samples} commands, bit for bit")
        return
    if other is None:
        count = f"{result.differing_samples} of {result.samples} commands"
        first = f"the first at sample {result.first_difference}"
        show(Text("different", "red") + f": {count}, {first}")
    else:
        span = f"{result.command_min:.4g} to {result.command_max:.4g} {unit}"
        limited = f"{result.limited_samples} samples limited"
        show(f"with {other} the command ranges from {span}, {limited}")
    if (error := result.predicted) is not None:
        predicted = _errors(error.peak_percent, error.rms_percent)
        recorded = _errors(error.recorded_peak_percent, error.recorded_rms_percent)
        show(f"predicted error: {predicted}; recorded error of the same samples: {recorded}")
    largest, rms = result.largest_difference, result.rms_difference
    show(f"largest difference {largest:.4g} {unit}, rms {rms:.4g} {unit}")


def _errors(peak_percent: float | None, rms_percent: float | None) -> str:
    return f"{quantity(peak_percent, '%')} peak, {quantity(rms_percent, '%')} rms"
