"""The comparison as a self-contained HTML page with tables and figures."""

from collections.abc import Iterator, Sequence
from functools import partial

import numpy as np
from matplotlib.axes import Axes

from hilctl.lab.comparison.compare import Comparison, headings, notes, table_rows
from hilctl.lab.identify.data.records import SteadyLoop
from hilctl.lab.identify.model_page import record_sheet
from hilctl.lab.pages import html
from hilctl.lab.pages.figure_layout import FigureSpec, Panel
from hilctl.lab.pages.plot_style import NAMED, plain_numbers

_STYLES = ("-", "--", ":")


def comparison_page(comparison: Comparison) -> str:
    """Return the page as HTML."""
    body = [
        html.paragraph(", ".join(comparison.sources), "file"),
        html.grid(headings(comparison), table_rows(comparison)),
        *map(html.paragraph, notes(comparison)),
        html.grid(("model", "description"), [(row.name, row.title) for row in comparison.rows]),
        html.figures(comparison_sheets(comparison)),
    ]
    return html.document("Comparison of models", body)


def comparison_sheets(comparison: Comparison) -> Iterator[FigureSpec]:
    """Yield errors of all models over frequency, and the fastest loop with each model."""
    loops, rows = comparison.loops, comparison.rows
    hz = [loop.frequency_hz for loop in loops]
    modelled = [(row.name, hz, [error.peak_percent for error in row.error.errors]) for row in rows]
    panels = [Panel(partial(_draw_errors, lines=modelled), "model", 0.7)]
    if comparison.device:
        tried = []
        for row in rows:
            percents = [trial.peak_error_percent for trial in row.trials]
            tried.append((row.name, [trial.frequency_hz for trial in row.trials], percents))
        panels.append(Panel(partial(_draw_errors, lines=tried), "compensated", 0.7))
    yield FigureSpec("errors", "Largest error against frequency.", tuple(panels))
    number = _fastest(loops)
    for k, row in enumerate(rows):
        modelled_um, unit = row.error.modelled_um[number], row.model.input_unit
        name, colour = f"{row.name} model", NAMED[k % len(NAMED)]
        yield record_sheet(loops[number], modelled_um, unit, name, colour)


def _fastest(loops: Sequence[SteadyLoop]) -> int:
    """Return the number of the largest of the fastest loops."""
    return max(
        range(len(loops)),
        key=lambda i: (round(loops[i].frequency_hz, 3), float(np.ptp(loops[i].displacement_um))),
    )


def _draw_errors(
    axes: Axes, lines: Sequence[tuple[str, Sequence[float], Sequence[float | None]]]
) -> None:
    for k, (name, frequencies_hz, percents) in enumerate(lines):
        worst: dict[float, float] = {}
        for hz, percent in zip(frequencies_hz, percents, strict=True):
            if percent is not None:
                worst[round(hz, 3)] = max(percent, worst.get(round(hz, 3), 0.0))
        points = sorted(worst.items())
        axes.plot([hz for hz, _ in points], [percent for _, percent in points], marker="o",
                  color=NAMED[k % len(NAMED)], linestyle=_STYLES[k // len(NAMED) % len(_STYLES)],
                  label=name)  # fmt: skip
    axes.set(xlabel="frequency, Hz", ylabel="peak error, % of peak-to-peak", yscale="log")
    plain_numbers(axes)
