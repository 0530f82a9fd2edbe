"""The command that compares models."""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer

from hilctl.base.errors import InputError
from hilctl.base.files import check_writable
from hilctl.cli.options import AsJson, Overwrite, Settings
from hilctl.cli.output import print_json

Models = Annotated[
    list[str] | None,
    typer.Option(
        metavar="KIND", help="Kinds, commas between, or model files; else all. May be repeated."
    ),
]
TryIn = Annotated[
    Path | None,
    typer.Option(help="Compensated experiment to try the inverses in; else as recorded."),
]
Frequencies = Annotated[
    str | None, typer.Option(help="Of the trials, in Hz, commas between; else 10,100,200.")
]


def compare(
    files: Annotated[
        list[Path], typer.Argument(metavar="RUN", help="Recordings (MCAP) of steady loops.")
    ],
    models: Models = None,
    experiment: TryIn = None,
    frequencies: Frequencies = None,
    points: Annotated[int, typer.Option(min=16, help="Points a loop.")] = 300,
    html: Annotated[Path | None, typer.Option(help="Page with table and figure to write.")] = None,
    save: Annotated[Path | None, typer.Option(help="Folder for a model file of each.")] = None,
    settings: Settings = None,
    overwrite: Overwrite = False,
    as_json: AsJson = False,
) -> None:
    """Identify models of the literature on the same loops, and compare them."""
    from hilctl import api
    from hilctl.cli.compare_view import render
    from hilctl.cli.console import print_rich
    from hilctl.cli.progress import shown_progress

    names = [name for text in models or [] for name in text.split(",") if name]
    numbers = _numbers(frequencies)
    with shown_progress("compare", quiet=as_json) as on_progress:
        comparison = api.compare(
            files,
            names,
            experiment=experiment,
            settings=settings or [],
            frequencies_hz=numbers,
            points=points,
            html=html,
            save=save,
            overwrite=overwrite,
            on_progress=on_progress,
        )
    if as_json:
        print_json(comparison.to_mapping())
    else:
        print_rich(render(comparison))


def _numbers(text: str | None) -> list[float] | None:
    if text is None:
        return None
    try:
        return [float(part) for part in text.split(",")]
    except ValueError:
        raise InputError(f"--frequencies must be numbers with commas between: {text!r}") from None


def check_page(html: Path | None, *, overwrite: bool, inputs: Sequence[Path] = ()) -> None:
    """Refuse a page that can't be written, before there is anything to put on it.

    Raises:
        InputError: It exists, and may not be replaced, it can't be written, or it is an input.
    """
    if html is not None:
        check_writable(html, overwrite=overwrite, inputs=inputs)
