"""HTML pages of an identified or a refined model, with plots of model and data."""

from collections.abc import Iterator, Sequence

import numpy as np
from matplotlib.axes import Axes

from hilctl.base.formatting import short_name
from hilctl.base.types import F64, I64
from hilctl.lab.identify.data.records import History, Record, turning_points
from hilctl.lab.identify.evaluation import Evaluation
from hilctl.lab.identify.model_quality import Verdict
from hilctl.lab.identify.pipeline import Identification
from hilctl.lab.identify.refinement import Refinement
from hilctl.lab.identify.summary import (
    candidate_table,
    change_tables,
    details,
    loop_table,
    parameter_texts,
    refinement_lines,
    stroke_table,
)
from hilctl.lab.pages import html
from hilctl.lab.pages.figure_layout import FigureSpec, Panel
from hilctl.lab.pages.plot_style import DISPLACEMENT, ERROR, PALE, min_max
from hilctl.models.base import HysteresisModel
from hilctl.models.model_file import dump_model

MOST_RECORDS = 36
MOST_RUNS = 12
_CYCLES, _CYCLE_POINTS = 16, 300  # drawn of a history of loops


def identification_page(found: Identification) -> str:
    """Return the page as HTML."""
    fit = found.fit
    unit = fit.model.input_unit
    body = [*errors_by_stroke(found.verdict), *map(html.paragraph, found.verdict.notes)]
    body += _head(fit.model, [*details(found), fit.model.provenance.method])
    if found.candidates:
        body += ["<h2>Kinds of model</h2>", html.grid(*candidate_table(found))]
    if (held_out := found.held_out) is not None:
        body += ["<h2>Errors on held-out data</h2>"]
        body += [html.grid(*loop_table(held_out.judgement.errors))]
        body += ["<h2>Model and held-out data</h2>"]
        body += drawn_records(held_out.judgement, held_out.records, unit)
    body += [
        "<h2>Errors on fitted data</h2>",
        html.grid(*loop_table(fit.errors)),
        "<h2>Model and data</h2>",
        *drawn_records(fit, found.data, unit),
        "<h2>Parameters</h2>",
        html.grid(("name", "value"), parameter_texts(fit)),
    ]
    return html.document("Identified model", [*body, html.details("Model", dump_model(fit.model))])


def _head(model: HysteresisModel, lines: Sequence[str]) -> list[str]:
    """Return sources and results."""
    source = html.paragraph(", ".join(model.provenance.source), "file")
    return [source, *map(html.paragraph, lines)]


def errors_by_stroke(verdict: Verdict) -> list[str]:
    """Return the grade and the errors of a verdict by stroke."""
    meaning = (
        "Errors are in percent of a motion's own peak-to-peak; 90 % of places and frequencies "
        "have no larger one than promised."
    )
    return [
        "<h2>Errors by stroke</h2>",
        html.paragraph(verdict.headline),
        html.grid(*stroke_table(verdict)),
        html.paragraph(meaning),
    ]


def drawn_records(
    judged: Evaluation, data: Sequence[Record], unit: str, most: int = MOST_RECORDS
) -> Iterator[str]:
    """Yield figures of the first records, measured and modelled, and a note if some are omitted."""
    if len(data) > most:
        yield html.paragraph(f"The first {most} of {len(data)}.")
    pairs = zip(data[:most], judged.modelled_um, strict=False)
    yield html.figures(record_sheet(record, modelled, unit) for record, modelled in pairs)


def record_sheet(
    record: Record, modelled_um: F64, unit: str, name: str = "model", colour: str = DISPLACEMENT
) -> FigureSpec:
    """Return displacement and error of a model: of loops against command, otherwise over time."""
    part = slice(record.command.size - modelled_um.size, None)
    command, measured_um = record.command[part], record.displacement_um[part]
    time_s = record.time_s[part] if isinstance(record, History) else None
    cycles = np.append(np.arange(command.size), 0)  # closed
    if time_s is not None and "-loops" in record.label:  # a step of characterise
        time_s, cycles = None, _some_cycles(command)

    def line(axes: Axes, values: F64, colour: str, label: str = "_error", width: float = 0.9
             ) -> None:  # fmt: skip
        if time_s is None:
            shown = np.append(command, np.nan)[cycles], np.append(values, np.nan)[cycles]
        else:
            shown = min_max(time_s, values)
        axes.plot(*shown, color=colour, linewidth=width, label=label)
        axes.set_xlabel(f"command, {unit}" if time_s is None else "time, s")

    def displacements(axes: Axes) -> None:
        line(axes, measured_um, PALE, "measured", 2.2)
        line(axes, modelled_um, colour, name)
        axes.set_ylabel("displacement, µm")

    def errors(axes: Axes) -> None:
        line(axes, modelled_um - measured_um, ERROR)
        axes.set_ylabel("error, µm")

    panels = (
        Panel(displacements, height=0.75 if time_s is None else 0.5),
        Panel(errors, height=0.35),
    )
    caption = f"{short_name(record.label)}: measurement and {name}."
    return FigureSpec("record", caption, panels, stacked=True)


def _some_cycles(command: F64) -> I64:
    """Return samples of cycles evenly spread over a history, with -1 after each cycle."""
    turns = np.concatenate(([0], turning_points(command), [command.size - 1]))
    wanted = np.linspace(0, command.size, _CYCLES)
    first = np.unique(np.searchsorted(turns, wanted).clip(0, max(0, turns.size - 3)))
    ends = [(turns[k], turns[min(k + 2, turns.size - 1)]) for k in first]
    cycles = [np.linspace(*each, _CYCLE_POINTS).astype(np.int64) for each in ends]
    return np.concatenate([np.append(each, -1) for each in cycles])


def refinement_page(found: Refinement) -> str:
    """Return the page as HTML."""
    by_run, by_stroke = change_tables(found)
    body = [
        *_head(found.model, [*refinement_lines(found), found.held_out.how]),
        "<h2>Errors on held-out data</h2>",
        html.grid(*by_run),
        "<h2>Errors by stroke</h2>",
        html.grid(*by_stroke),
    ]
    for heading, judged in (("Before", found.before), ("After", found.after)):
        body += [f"<h2>{heading}</h2>"]
        body += drawn_records(judged, found.held_out.records, found.model.input_unit, MOST_RUNS)
    return html.document("Refined model", [*body, html.details("Model", dump_model(found.model))])
