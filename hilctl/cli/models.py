"""Commands on models: identify, refine, compare, export-model."""

import json
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Group, RenderableType

from hilctl import api
from hilctl.base.errors import InputError
from hilctl.base.files import check_writable, write_text
from hilctl.cli.console import listing, print_rich, progress_bar, table
from hilctl.cli.options import (
    AsJson,
    HtmlPage,
    Overwrite,
    Settings,
    recording_paths,
    recordings_argument,
)
from hilctl.cli.output import print_result
from hilctl.lab.comparison.compare import Comparison, headings, notes, table_rows
from hilctl.lab.identify.pipeline import Identification
from hilctl.lab.identify.refinement import Refinement
from hilctl.lab.identify.registry import all_fits
from hilctl.lab.identify.settings import setting_rows
from hilctl.lab.identify.summary import (
    candidate_table,
    change_tables,
    loop_table,
    parameter_texts,
    refinement_lines,
    summary,
)
from hilctl.run.control.client import finish_dead_runs


def _kinds() -> list[tuple[str, str]]:
    """Return kinds of model, for completion."""
    return [(kind, each.title) for kind, each in all_fits().items()]


def _setting_keys() -> list[tuple[str, str]]:
    """Return settings of a fit, for completion."""
    return [(f"{row[0]}=", row[-1]) for row in setting_rows()]


TableUnit = Annotated[str | None, typer.Option(help="Unit of the command in a table, A or V.")]
TableColumn = Annotated[str | None, typer.Option(help="Column of a table: name, or number from 1.")]
TableScale = Annotated[
    float | None, typer.Option(help="Factor from a table's column to µm, or to the command's unit.")
]
SkipRows = Annotated[
    int | None, typer.Option(min=0, help="Lines at the start of a text table to skip.")
]
RateHz = Annotated[float | None, typer.Option(help="Sample rate of a table without a time column.")]
Whole = Annotated[
    bool, typer.Option("--whole", help="Evaluate complete histories instead of steady cycles.")
]
LeaveOut = Annotated[
    list[str] | None,
    typer.Option(
        metavar="LABEL", help="Loop to omit (its label, or the beginning of it); may be repeated."
    ),
]
ModelArgument = Annotated[Path, typer.Argument(help="Model file.", metavar="MODEL")]
ModelFile = Annotated[Path | None, typer.Option(help="Model file to write.")]
Validate = Annotated[
    list[Path] | None,
    typer.Option(
        metavar="FILE",
        help="File to validate the model with; may be repeated.",
        autocompletion=recording_paths,
    ),
]
Scheduler = Annotated[
    str | None,
    typer.Option(
        help="none, threads, processes, or a Dask scheduler address; default for auto: threads."
    ),
]
FitTexts = Annotated[
    list[str] | None,
    typer.Option(
        "--set",
        metavar="KEY=VALUE",
        help="Setting of the fit (see --settings); may be repeated.",
        autocompletion=_setting_keys,
    ),
]
Models = Annotated[
    list[str] | None,
    typer.Option(
        metavar="KIND",
        help="Kinds (separated by commas) or model files; default: all. May be repeated.",
        autocompletion=_kinds,
    ),
]
TryIn = Annotated[
    Path | None,
    typer.Option(help="Compensated experiment to test the inverses in; default: as recorded."),
]
Frequencies = Annotated[
    str | None,
    typer.Option(
        help="Frequencies of the tests, Hz, separated by commas; default: the lowest, a middle and"
        " the highest recorded one."
    ),
]


def _list_settings(requested: bool) -> None:
    if not requested:
        return
    kinds = [(kind, each.title, each.found_by, each.data) for kind, each in all_fits().items()]
    print_rich(listing("", [("--model", "description", "identified by", "from"), *kinds]))
    headings = ("--set", "default", "limits", "of", "description")
    print_rich("", listing("", [headings, *setting_rows()]))
    raise typer.Exit


ListSettings = Annotated[
    bool,
    typer.Option(
        "--settings", callback=_list_settings, is_eager=True,
        help="List all kinds of model and all settings.",
    ),
]  # fmt: skip


def identify(
    files: Annotated[
        list[Path],
        recordings_argument(
            "Recordings (MCAP) or tables (text, .mat, .npz, .npy, .parquet).", "FILE"
        ),
    ],
    model: Annotated[
        str, typer.Option(help="Kind of model, or auto.", autocompletion=_kinds)
    ] = "auto",
    output: ModelFile = None,
    settings: FitTexts = None,
    list_settings: ListSettings = False,
    unit: TableUnit = None,
    command_column: TableColumn = None,
    displacement_column: TableColumn = None,
    time_column: TableColumn = None,
    rate_hz: RateHz = None,
    command_scale: TableScale = None,
    displacement_scale: TableScale = None,
    skip_rows: SkipRows = None,
    whole: Whole = False,
    leave_out: LeaveOut = None,
    validate: Validate = None,
    scheduler: Scheduler = None,
    html: HtmlPage = None,
    overwrite: Overwrite = False,
    as_json: AsJson = False,
) -> None:
    """Identify a model's parameters from recordings or measured tables."""
    del list_settings
    if html is not None:
        check_writable(html, overwrite=overwrite, inputs=[*files, *(validate or [])])
    table = {
        "table.unit": unit,
        "table.command_column": column_of(command_column),
        "table.displacement_column": column_of(displacement_column),
        "table.time_column": column_of(time_column),
        "table.rate_hz": rate_hz,
        "table.command_scale": command_scale,
        "table.displacement_scale": displacement_scale,
        "table.skip_rows": skip_rows,
        "whole": whole or None,
        "leave_out": leave_out or None,
    }
    texts = [f"{key}={json.dumps(value)}" for key, value in table.items() if value is not None]
    finish_dead_runs()
    with progress_bar("identify", quiet=as_json) as progress:
        result = api.identify(
            files,
            output,
            model=model,
            settings=[*texts, *(settings or [])],
            validate=validate or [],
            scheduler=scheduler,
            overwrite=overwrite,
            on_progress=progress,
        )
    if html is not None:
        from hilctl.lab.identify.model_page import identification_page  # it imports matplotlib

        write_text(html, identification_page(result), overwrite=True)
    refused = result.verdict.grade == "not a model"
    values = {"output": str(output) if output and not refused else None, **result.to_mapping()}
    print_result(values, lambda: print_identification(result, output), as_json=as_json)
    if refused:
        raise typer.Exit(1)


def column_of(text: str | None) -> str | int | None:
    """Return the column that an option names, by name or number."""
    return int(text) if text is not None and text.isdecimal() else text


def refine(
    model: ModelArgument,
    runs: Annotated[
        list[Path], recordings_argument("Recordings (MCAP): compensated, learned, or neither.")
    ],
    output: ModelFile = None,
    validate: Validate = None,
    html: HtmlPage = None,
    overwrite: Overwrite = False,
    as_json: AsJson = False,
) -> None:
    """Improve a model from recordings of runs (written only if it is better)."""
    if html is not None:
        check_writable(html, overwrite=overwrite, inputs=[model, *runs, *(validate or [])])
    finish_dead_runs()
    with progress_bar("refine", quiet=as_json) as progress:
        result = api.refine(
            model,
            runs,
            output,
            validate=validate or [],
            overwrite=overwrite,
            on_progress=progress,
        )
    if html is not None:
        from hilctl.lab.identify.model_page import refinement_page  # it imports matplotlib

        write_text(html, refinement_page(result), overwrite=True)
    written = str(output) if output and result.better else None
    values = {"output": written, **result.to_mapping()}
    print_result(values, lambda: print_refinement(result, output), as_json=as_json)
    if not result.better:
        raise typer.Exit(1)


def print_refinement(result: Refinement, output: Path | None) -> None:
    """Print the errors of the old and the new model on held-out data."""
    for line in refinement_lines(result):
        print(line)
    by_run, by_stroke = change_tables(result)
    print_rich(table(f"validation: {result.held_out.how}", *by_run), table("by stroke", *by_stroke))
    if output is not None:
        print(f"model: {output}" if result.better else f"{output}: not written")


def export_model(
    model: ModelArgument,
    output: Annotated[
        Path,
        typer.Argument(
            help="File to write (.c or .m); the function has its name.", metavar="OUTPUT"
        ),
    ],
    rate_hz: Annotated[float, typer.Option(help="Sample rate of the signals.")],
    forward: Annotated[
        bool, typer.Option("--forward", help="Write the model instead of its inverse.")
    ] = False,
    overwrite: Overwrite = False,
    as_json: AsJson = False,
) -> None:
    """Write the inverse of a model as one C or MATLAB function."""
    api.export_model(model, output, rate_hz, forward=forward, overwrite=overwrite)
    print_result({"output": str(output)}, lambda: print(f"{output}: written"), as_json=as_json)


def compare(
    files: Annotated[list[Path], recordings_argument("Recordings (MCAP) of steady loops.")],
    models: Models = None,
    experiment: TryIn = None,
    frequencies: Frequencies = None,
    points: Annotated[int, typer.Option(min=16, help="Points per loop.")] = 300,
    html: HtmlPage = None,
    save: Annotated[Path | None, typer.Option(help="Folder for the model files.")] = None,
    settings: Settings = None,
    overwrite: Overwrite = False,
    as_json: AsJson = False,
) -> None:
    """Identify models of the literature on the same loops and compare them."""
    names = [name for text in models or [] for name in text.split(",") if name]
    with progress_bar("compare", quiet=as_json) as on_progress:
        comparison = api.compare(
            files,
            names,
            experiment=experiment,
            settings=settings or [],
            frequencies_hz=_numbers(frequencies),
            points=points,
            html=html,
            save=save,
            overwrite=overwrite,
            on_progress=on_progress,
        )
    values = comparison.to_mapping()
    print_result(values, lambda: print_rich(render_comparison(comparison)), as_json=as_json)


def _numbers(text: str | None) -> list[float] | None:
    if text is None:
        return None
    try:
        return [float(part) for part in text.split(",")]
    except ValueError:
        rule = "must be numbers separated by commas"
        raise InputError(f"--frequencies {rule} (got {text!r})") from None


def print_identification(result: Identification, output: Path | None) -> None:
    """Print the quality of a model, its errors per loop, its parameters and its file."""
    fit, held_out = result.fit, result.held_out
    for line in summary(result):
        print(line)
    if held_out is not None:
        loops = loop_table(held_out.judgement.errors)
        print_rich(table(f"validation: {held_out.how}", *loops, left={"loop"}))
    if result.candidates:
        print_rich(table("kinds of model", *candidate_table(result), left={"tried"}))
    title = f"fit: {fit.model.provenance.method}"
    print_rich(table(title, *loop_table(fit.errors), left={"loop"}))
    if parameters := ", ".join(f"{name} {text}" for name, text in parameter_texts(fit)):
        print(f"parameters: {parameters}")
    if output is not None:
        written = result.verdict.grade != "not a model"
        print(f"model: {output}" if written else f"{output}: not written")


def render_comparison(comparison: Comparison) -> RenderableType:
    """Return the tables of a comparison."""
    title = f"models on {', '.join(comparison.sources)}"
    errors = table(title, headings(comparison), table_rows(comparison))
    titles = [(row.name, row.title) for row in comparison.rows]
    return Group(errors, listing("", titles), *notes(comparison))
