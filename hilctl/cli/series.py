"""Commands about many runs at once: figures for a paper; and what ``report`` does with several."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from hilctl.cli.comparing import check_page
from hilctl.cli.options import AsJson, Overwrite
from hilctl.cli.output import finish_orphans, print_json

if TYPE_CHECKING:
    from hilctl.series.collect import RunSeries

RunsInput = Annotated[
    list[Path], typer.Argument(help="Recordings (MCAP), or a campaign's folder.", metavar="RUN...")
]  # fmt: skip
OtherModel = Annotated[
    Path | None, typer.Option(help="Model to hold against measured loops; else the recorded ones.")
]
FOLDER = "figures"
"""Where figures go: in the folder that they are of, or in this one."""


def figures(
    runs: RunsInput,
    output: Annotated[
        Path | None, typer.Option(help=f"Folder for the figures; {FOLDER} in a campaign's.")
    ] = None,
    formats: Annotated[
        str, typer.Option("--format", help="svg, pdf or png; several with commas between.")
    ] = "svg,pdf,png",
    width: Annotated[
        Literal["single", "double"],
        typer.Option(help="One column of a journal, 85 mm, or two, 175 mm."),
    ] = "double",
    model: OtherModel = None,
    overwrite: Overwrite = False,
    as_json: AsJson = False,
) -> None:
    """Draw the figures that apply to runs, by what varied among them: loops, trends, errors."""
    from hilctl.analysis.vector import formats_of
    from hilctl.cli.progress import shown_progress
    from hilctl.series.files import write_sheets

    chosen = formats_of(formats)
    folder = output or (runs[0] / FOLDER if runs[0].is_dir() else Path(FOLDER))
    series = collected(runs, model, quiet=as_json)
    with shown_progress("figures", quiet=as_json) as on_done:
        written = write_sheets(series, folder, chosen, width, overwrite=overwrite, on_done=on_done)
    if as_json:
        print_json({"figures": {str(path): caption for path, caption in written.items()}})
        return
    for path, caption in written.items():
        print(f"{path}: {caption}")


def collected(runs: Sequence[Path], model: Path | None, *, quiet: bool) -> "RunSeries":
    """Read runs, with a bar of progress.

    Raises:
        InputError: They, or the model, can't be read.
    """
    from hilctl.cli.progress import shown_progress
    from hilctl.models.files import load_model
    from hilctl.series.collect import collect

    finish_orphans()
    known = load_model(model) if model else None
    with shown_progress("read", quiet=quiet) as on_read:
        return collect(runs, known, on_read)


def report_series(
    runs: Sequence[Path],
    html: Path | None,
    model: Path | None,
    *,
    overwrite: bool,
    as_json: bool,
) -> None:
    """Say what came out of several runs, and write the page of all of them where one is wanted."""
    from hilctl.cli.console import print_rich
    from hilctl.cli.series_view import render_series
    from hilctl.series.page import write_series
    from hilctl.series.result import series_mapping

    check_page(html, overwrite=overwrite)
    series = collected(runs, model, quiet=as_json)
    if html is not None:
        write_series(series, html)
    if as_json:
        print_json(series_mapping(series))
    else:
        print_rich(render_series(series))
