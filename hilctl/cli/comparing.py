"""The command that holds models against one another."""

import time
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from hilctl.base.errors import InputError
from hilctl.cli.options import AsJson, Overwrite, Settings, finish_orphans, print_json

if TYPE_CHECKING:
    from hilctl.comparison.compare import Comparison


def compare(
    files: Annotated[list[Path], typer.Argument(help="Recordings (MCAP) of steady loops.")],
    models: Annotated[
        list[str] | None,
        typer.Option(help="Names, commas between, or model files; else all. May be repeated."),
    ] = None,
    experiment: Annotated[
        Path | None,
        typer.Option(help="Compensated experiment to try the inverses in; else as recorded."),
    ] = None,
    frequencies: Annotated[
        str | None, typer.Option(help="Of the trials, in Hz, commas between; else 10,100,200.")
    ] = None,
    points: Annotated[int, typer.Option(min=16, help="Points a loop.")] = 300,
    html: Annotated[Path | None, typer.Option(help="Page with table and figure to write.")] = None,
    save: Annotated[
        Path | None, typer.Option(help="Folder for a model file of each, ready to run.")
    ] = None,
    settings: Settings = None,
    overwrite: Overwrite = False,
    as_json: AsJson = False,
) -> None:
    """Find models of the literature on the same loops, and hold them against one another."""
    from hilctl.cli.compare_view import render, shown_progress
    from hilctl.cli.console import print_rich
    from hilctl.comparison.catalogue import CATALOGUE
    from hilctl.comparison.compare import Request
    from hilctl.comparison.compare import compare as hold
    from hilctl.comparison.saving import check_free

    if html is not None and html.exists() and not overwrite:
        raise InputError(f"{html}: exists already: give another name, or --overwrite")
    names = [name for text in models or [] for name in text.split(",") if name]
    if save is not None:
        check_free(tuple(names or CATALOGUE), save, overwrite=overwrite)
    finish_orphans()
    request = Request(
        recordings=files,
        models=names,
        experiment=experiment,
        settings=settings or [],
        frequencies_hz=_numbers(frequencies),
        points=points,
    )
    with shown_progress(quiet=as_json) as on_progress:
        comparison = hold(request, time.perf_counter, on_progress)
    _write(comparison, html, save, overwrite=overwrite)
    if as_json:
        print_json(comparison.to_mapping())
    else:
        print_rich(render(comparison))


def _write(
    comparison: "Comparison", html: Path | None, save: Path | None, *, overwrite: bool
) -> None:
    from hilctl.comparison.page import write_comparison
    from hilctl.comparison.saving import save_models

    if html is not None:
        write_comparison(comparison, html)
    if save is not None:
        created = datetime.now(UTC).isoformat(timespec="seconds")
        save_models(comparison, save, created=created, overwrite=overwrite)


def _numbers(text: str | None) -> list[float] | None:
    if text is None:
        return None
    try:
        return [float(part) for part in text.split(",")]
    except ValueError:
        raise InputError(f"--frequencies must be numbers with commas between: {text!r}") from None
