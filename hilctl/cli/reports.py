"""Commands that evaluate recordings: report, figures, replay."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer
from rich.console import Group
from rich.table import Table
from rich.text import Text

from hilctl import api
from hilctl.analysis.report_table import quality_rows, run_rows, segment_table
from hilctl.base.errors import InputError
from hilctl.base.formatting import printable, quantity
from hilctl.cli.console import console, print_rich, progress_bar
from hilctl.cli.options import AsJson, FromTime, Overwrite, RecordingFile, ToTime
from hilctl.cli.safe_streams import print_json
from hilctl.run.dead_runs import finish_dead_runs

if TYPE_CHECKING:
    from hilctl.analysis.replay import ReplayResult
    from hilctl.analysis.run_metrics import RunReport
    from hilctl.studies.multi_run.collect import RunSeries

RunsInput = Annotated[
    list[Path], typer.Argument(help="Recordings (MCAP), or a campaign folder.", metavar="RUN")
]
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
    html: Annotated[
        Path | None, typer.Option(metavar="FILE", help="HTML page with plots to write.")
    ] = None,
    before: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE", help="Recording of the same motion without compensator, for the page."
        ),
    ] = None,
    model: OtherModel = None,
    from_s: FromTime = None,
    to_s: ToTime = None,
    overwrite: Overwrite = False,
    as_json: AsJson = False,
) -> None:
    """Evaluate a recording (hysteresis, error, noise, lateness), several, or a campaign."""
    if len(runs) > 1 or runs[0].is_dir():
        if from_s is not None or to_s is not None or before is not None:
            raise InputError("--from, --to and --before apply to the report of one recording only")
        report_series(runs, html, model, overwrite=overwrite, as_json=as_json)
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
    if as_json:
        print_json(summary.to_mapping())
    else:
        print_rich(render_report(summary))


def replay(
    recording: RecordingFile,
    model: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Model to replay with instead of the recorded one."),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Recompute the commands from the recorded reference and compare them bit for bit."""
    finish_dead_runs()
    result = api.replay(recording, model)
    if as_json:
        print_json(result.to_mapping())
    else:
        print_replay(result, other=model)
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
    folder = output or (runs[0] / FOLDER if runs[0].is_dir() else Path(FOLDER))
    written: dict[Path, str] = {}
    with progress_bar("figures", quiet=as_json) as on_progress:
        api.figures(
            runs, folder, formats=formats, width=width, model=model, overwrite=overwrite,
            on_progress=on_progress, on_written=written.__setitem__,
        )  # fmt: skip
    if as_json:
        print_json({"figures": {str(path): caption for path, caption in written.items()}})
        return
    for path, caption in written.items():
        print(f"{path}: {caption}")


def report_series(
    runs: Sequence[Path],
    html: Path | None,
    model: Path | None,
    *,
    overwrite: bool,
    as_json: bool,
) -> None:
    """Report several runs, and write their page if requested."""
    from hilctl.studies.multi_run.multi_run_page import series_mapping  # imports matplotlib

    with progress_bar("read", quiet=as_json) as on_progress:
        series = api.report_runs(
            runs, html, model=model, overwrite=overwrite, on_progress=on_progress
        )
    if as_json:
        print_json(series_mapping(series))
    else:
        print_rich(render_series(series))


def render_report(report: "RunReport") -> Group:
    """Return the tables of a report; the segments have their own if there are several."""
    title = printable(report.name) or "run"
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


def _segments(report: "RunReport") -> Table:
    table = Table(title="segments, worst first", title_justify="left")
    headings, rows = segment_table(report)
    shown = [i for i, heading in enumerate(headings) if heading not in _PAGE_ONLY]
    for i in shown:
        table.add_column(headings[i], justify="right" if i else "left", no_wrap=True)
    for cells in rows:
        table.add_row(*(Text(cells[i]) for i in shown))
    return table


def _minutes(report: "RunReport") -> Table:
    minutes = report.lateness_by_minute
    title = "lateness per minute, µs"
    if len(minutes) > _MOST_MINUTES:
        # --json contains all of them.
        title += f": worst {_MOST_MINUTES} of {len(minutes)}"
        worst = sorted(minutes, key=lambda each: -each["max"])[:_MOST_MINUTES]
        minutes = sorted(worst, key=lambda each: each["minute"])
    table = Table(title=title, title_justify="left")
    for heading in minutes[0]:
        table.add_column(heading, justify="right", no_wrap=True)
    for minute in minutes:
        cells = (f"{v:,}" if name in _COUNTS else f"{v:.4g}" for name, v in minute.items())
        table.add_row(*cells)
    return table


def render_series(series: "RunSeries") -> Group:
    """Return the summary of several runs and a table of them."""
    from hilctl.studies.multi_run.multi_run_page import MOST_ROWS, run_table  # imports matplotlib
    from hilctl.studies.multi_run.trend import headline

    headings, rows = run_table(series, MOST_ROWS, short=True)
    table = Table(title=Text(printable(series.name)), title_justify="left")
    for number, heading in enumerate(headings):
        left = number == 0 or heading == "result"
        table.add_column(heading, justify="left" if left else "right", overflow="fold")
    for cells in rows:
        table.add_row(*(Text(printable(cell)) for cell in cells))
    problems = [Text(f"not read: {printable(each)}", "red") for each in series.missing]
    named = [] if series.is_campaign else [(run.number, run.recording) for run in series.runs]
    files = [Text(f"{number}: {printable(name)}") for number, name in named]
    return Group(Text(printable(" ".join(headline(series)))), *problems, table, *files)


def print_replay(result: "ReplayResult", *, other: Path | None) -> None:
    """Print the differences between recomputed and recorded commands."""
    terminal = console()
    unit = result.command_unit
    if result.left_out_samples:
        terminal.print(f"{result.left_out_samples} samples after a gap cannot be replayed")
    if other is None and result.identical:
        terminal.print(Text("identical", "green") + f": {result.samples} commands, bit for bit")
        return
    if other is None:
        terminal.print(
            Text("different", "red") + f": {result.differing_samples} of {result.samples} "
            f"commands, the first at sample {result.first_difference}"
        )
    else:
        terminal.print(
            f"with {other} the command ranges from {result.command_min:.4g} to "
            f"{result.command_max:.4g} {unit}, {result.limited_samples} samples limited"
        )
    if (error := result.predicted) is not None:
        terminal.print(
            f"predicted error: {quantity(error.peak_percent, '%')} peak, "
            f"{quantity(error.rms_percent, '%')} rms; recorded error of the same samples: "
            f"{quantity(error.recorded_peak_percent, '%')} peak, "
            f"{quantity(error.recorded_rms_percent, '%')} rms"
        )
    terminal.print(
        f"largest difference {result.largest_difference:.4g} {unit}, "
        f"rms {result.rms_difference:.4g} {unit}"
    )
