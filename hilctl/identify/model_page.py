"""HTML pages of an identified or a refined model, with plots of model and data."""

from collections.abc import Sequence

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure

from hilctl.analysis import html
from hilctl.analysis.plot_style import DISPLACEMENT, ERROR, REFERENCE, STYLE
from hilctl.base.types import F64
from hilctl.identify.data.records import Record, SteadyLoop
from hilctl.identify.evaluation import Evaluation
from hilctl.identify.pipeline import Identification
from hilctl.identify.refine.refinement import Refinement
from hilctl.identify.summary import (
    HEADINGS,
    REFINEMENT_HEADINGS,
    error_rows,
    parameter_texts,
    refinement_rows,
    summary,
)
from hilctl.models.model_file import dump_model

COLUMNS = 3
MOST_RECORDS = 36
MOST_RUNS = 12
MOST_DRAWN = 20_000  # samples of a history per plot


def identification_page(found: Identification) -> str:
    """Return the page as HTML."""
    fit = found.fit
    unit = fit.model.input_unit
    title = f"Identified from {', '.join(fit.model.provenance.source)}"
    lines = fit.model.provenance.method, *summary(found)
    body = [f"<h1>{html.text(title)}</h1>", *map(html.paragraph, lines)]
    if (held_out := found.held_out) is not None:
        body += ["<h2>Errors on data not fitted</h2>"]
        body += [html.grid(HEADINGS, error_rows(held_out.judgement.errors), "numbers")]
        body += _drawn("Model and data not fitted", held_out.judgement, held_out.records, unit)
    body += [
        "<h2>Errors on data fitted</h2>",
        html.grid(HEADINGS, error_rows(fit.errors), "numbers"),
    ]
    body += _drawn("Model and data", fit, found.data, unit)
    body += ["<h2>Parameters</h2>", html.grid(("name", "value"), parameter_texts(fit), "numbers")]
    return html.document(html.text(title), [*body, html.details("Model", dump_model(fit.model))])


def _drawn(heading: str, judged: Evaluation, data: Sequence[Record], unit: str) -> list[str]:
    shown = data[:MOST_RECORDS]
    left_out = [f"<p>The first {len(shown)} of {len(data)}.</p>"] if len(shown) < len(data) else []
    figure = loops_figure(judged.modelled_um, shown, unit)
    return [f"<h2>{heading}</h2>", *left_out, html.wide_figure(heading, figure)]


@mpl.rc_context(STYLE)
def loops_figure(modelled_um: Sequence[F64], data: Sequence[Record], unit: str) -> Figure:
    """Draw displacement against command, measured and modelled, and the error below each."""
    columns = min(COLUMNS, len(data))
    rows = -(-len(data) // columns)
    figure = Figure(figsize=(3.6 * columns, 3.8 * rows))
    axes = figure.subplots(2 * rows, columns, squeeze=False, height_ratios=[3.0, 1.0] * rows)
    for each in axes.flat[:]:
        each.set_visible(False)
    for i, (record, modelled) in enumerate(zip(data, modelled_um, strict=False)):
        row, column = divmod(i, columns)
        upper, lower = axes[2 * row, column], axes[2 * row + 1, column]
        command, measured = (
            signal[-modelled.size :] for signal in (record.command, record.displacement_um)
        )
        steady = isinstance(record, SteadyLoop)
        step = 1 + command.size // MOST_DRAWN
        x = (command if steady else np.arange(command.size))[::step]
        upper.plot(x, measured[::step], color=REFERENCE, label="measured", linewidth=1.6)
        upper.plot(x, modelled[::step], color=DISPLACEMENT, label="model", linewidth=0.9)
        lower.plot(x, (modelled - measured)[::step], color=ERROR)
        upper.set(title=record.label, ylabel="µm")
        lower.set(xlabel=f"command, {unit}" if steady else "sample", ylabel="error, µm")
        upper.set_visible(True)
        lower.set_visible(True)
    axes[0, 0].legend(loc="upper left")
    return figure


def refinement_page(found: Refinement) -> str:
    """Return the page as HTML."""
    after = found.choice.after
    shown = after.records[:MOST_RUNS]
    title = html.text(f"Refined: {', '.join(found.model.provenance.source)}")
    body = [
        f"<h1>{title}</h1>",
        html.paragraph(str(found)),
        html.paragraph(after.how),
        "<h2>Errors on runs not fitted</h2>",
        html.grid(REFINEMENT_HEADINGS, refinement_rows(found), "numbers"),
    ]
    for heading, held in (("Before", found.choice.before), ("After", after)):
        modelled = held.judgement.modelled_um[:MOST_RUNS]
        figure = loops_figure(modelled, shown, found.model.input_unit)
        body += [f"<h2>{heading}</h2>", html.wide_figure(heading, figure)]
    return html.document(title, [*body, html.details("Model", dump_model(found.model))])
