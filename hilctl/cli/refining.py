"""The command that improves a model from recordings of its use."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from hilctl.cli.comparing import check_page
from hilctl.cli.options import AsJson, Overwrite
from hilctl.cli.output import finish_orphans, print_json

if TYPE_CHECKING:
    from hilctl.identify.refine.command import Refinement

Validate = Annotated[
    list[Path] | None,
    typer.Option(metavar="RUN", help="Recording to judge the model on; may be repeated."),
]


def refine(
    model: Annotated[Path, typer.Argument(help="Model file.", metavar="MODEL")],
    runs: Annotated[
        list[Path],
        typer.Argument(metavar="RUN", help="Recordings (MCAP): compensated, learned, or neither."),
    ],
    output: Annotated[Path | None, typer.Option(help="Model file to write.")] = None,
    validate: Validate = None,
    html: Annotated[Path | None, typer.Option(help="Page of before and after to write.")] = None,
    overwrite: Overwrite = False,
    as_json: AsJson = False,
) -> None:
    """Improve a model from recordings of runs; it is written only where it has become better."""
    from hilctl import api
    from hilctl.cli.progress import shown_progress

    check_page(html, overwrite=overwrite, inputs=[model, *runs, *(validate or [])])
    finish_orphans()
    with shown_progress("refine", quiet=as_json) as progress:
        found = api.refine(
            model, runs, output, validate=validate or [], overwrite=overwrite, on_progress=progress
        )
    if html is not None:
        from hilctl.identify.refine.page import write_refinement

        write_refinement(found, html)
    if as_json:
        print_json({"output": str(output) if output and found.better else None,
                    **found.to_mapping()})  # fmt: skip
    else:
        _print(found, output)
    if not found.better:
        raise typer.Exit(1)


def _print(found: "Refinement", output: Path | None) -> None:
    from rich.table import Table

    from hilctl.cli.console import console
    from hilctl.identify.refine.page import HEADINGS, refinement_rows

    terminal = console()
    terminal.print(str(found))
    table = Table(title=f"not fitted: {found.choice.after.how}")
    for name in HEADINGS:
        table.add_column(name, justify="left" if name == HEADINGS[0] else "right")
    for row in refinement_rows(found):
        table.add_row(*row)
    terminal.print(table)
    if found.choice.own:
        terminal.print("constants, creep and drift of single runs were not learned")
    if output is not None:
        written = f"model: {output}" if found.better else f"{output} was not written"
        terminal.print(written, soft_wrap=True)
