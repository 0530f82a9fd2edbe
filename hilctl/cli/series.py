"""Commands about many runs at once: figures for a paper; and what ``report`` does with several."""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Literal

import typer

from hilctl.cli.options import AsJson, Overwrite
from hilctl.cli.output import print_json

RunsInput = Annotated[
    list[Path], typer.Argument(help="Recordings (MCAP), or a campaign's folder.", metavar="RUN")
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
    from hilctl import api
    from hilctl.cli.progress import shown_progress

    folder = output or (runs[0] / FOLDER if runs[0].is_dir() else Path(FOLDER))
    written: dict[Path, str] = {}
    with shown_progress("figures", quiet=as_json) as on_progress:
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
    """Say what came out of several runs, and write the page of all of them where one is wanted."""
    from hilctl import api
    from hilctl.cli.console import print_rich
    from hilctl.cli.progress import shown_progress
    from hilctl.cli.series_view import render_series
    from hilctl.series.page import series_mapping

    with shown_progress("read", quiet=as_json) as on_progress:
        series = api.report_runs(
            runs, html, model=model, overwrite=overwrite, on_progress=on_progress
        )
    if as_json:
        print_json(series_mapping(series))
    else:
        print_rich(render_series(series))
