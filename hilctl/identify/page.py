"""What was found as one self-contained page: model against data."""

import html
from collections.abc import Sequence
from pathlib import Path

import matplotlib as mpl
from matplotlib.figure import Figure

from hilctl.analysis.canvas import DISPLACEMENT, ERROR, REFERENCE, STYLE
from hilctl.analysis.html import document, grid, image, write_page
from hilctl.identify.bench import Bench
from hilctl.identify.command import Finding
from hilctl.identify.data import Loop, Record
from hilctl.identify.fit import modelled_um
from hilctl.identify.summary import HEADINGS, error_rows, parameter_texts, summary
from hilctl.models.files import dump_model
from hilctl.models.plays import PlayModel
from hilctl.models.staged import StagedModel

COLUMNS = 3
MOST_RECORDS = 36


def write_finding(finding: Finding, path: Path) -> None:
    """Write the page; one of that name is replaced.

    Raises:
        InputError: It can't be written.
    """
    write_page(finding_page(finding), path)


def finding_page(finding: Finding) -> str:
    """Return the page as HTML."""
    fit = finding.fit
    title = f"Identified from {', '.join(fit.model.provenance.source)}"
    body = [
        f"<h1>{html.escape(title)}</h1>",
        f"<p>{html.escape(fit.model.provenance.method)}</p>",
        *(f"<p>{html.escape(line)}</p>" for line in summary(finding)),
        "<h2>Errors</h2>",
        grid(HEADINGS, error_rows(fit.errors), "numbers"),
        *_drawn("Model and data", fit.model, finding.data),
    ]
    if finding.held_out is not None:
        body += ["<h2>Errors on data not fitted</h2>"]
        body += [grid(HEADINGS, error_rows(finding.held_out.errors), "numbers")]
        body += _drawn("Model and data not fitted", fit.model, finding.held_out_data)
    body += ["<h2>Parameters</h2>", grid(("name", "value"), parameter_texts(fit), "numbers")]
    body += [f"<details><summary>Model</summary><pre>{html.escape(dump_model(fit.model))}</pre>"]
    return document(html.escape(title), [*body, "</details>"])


def _drawn(heading: str, model: PlayModel | StagedModel, data: Sequence[Record]) -> list[str]:
    shown = data[:MOST_RECORDS]
    left_out = [f"<p>The first {len(shown)} of {len(data)}.</p>"] if len(shown) < len(data) else []
    return [f"<h2>{heading}</h2>", *left_out, image(heading, loops_figure(model, shown))]


@mpl.rc_context(STYLE)
def loops_figure(model: PlayModel | StagedModel, data: Sequence[Record]) -> Figure:
    """Draw displacement against command, measured and modelled, and the error below each.

    Args:
        model: The model.
        data: Loops and histories.
    """
    bench = Bench(data)
    responses_um = modelled_um(model, data, bench)
    columns = min(COLUMNS, len(data))
    rows = -(-len(data) // columns)
    figure = Figure(figsize=(3.6 * columns, 3.8 * rows))
    axes = figure.subplots(2 * rows, columns, squeeze=False, height_ratios=[3.0, 1.0] * rows)
    for each in axes.flat[:]:
        each.set_visible(False)
    for i, (record, place) in enumerate(zip(data, bench.places, strict=True)):
        row, column = divmod(i, columns)
        upper, lower = axes[2 * row, column], axes[2 * row + 1, column]
        command = record.run()[0][-(place.stop - place.start) :]
        measured, modelled = bench.target_um[place], responses_um[place]
        steady = isinstance(record, Loop)
        x = command if steady else range(command.size)
        upper.plot(x, measured, color=REFERENCE, label="measured", linewidth=1.6)
        upper.plot(x, modelled, color=DISPLACEMENT, label="model", linewidth=0.9)
        lower.plot(x, modelled - measured, color=ERROR)
        upper.set(title=record.label, ylabel="um")
        lower.set(xlabel=f"command, {model.input_unit}" if steady else "sample", ylabel="error, um")
        upper.set_visible(True)
        lower.set_visible(True)
    axes[0, 0].legend(loc="upper left")
    return figure
