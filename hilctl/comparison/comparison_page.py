"""The comparison as a self-contained HTML page with a table and a figure."""

import html
from collections.abc import Sequence

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure, SubFigure

from hilctl.analysis.html import document, grid, wide_figure
from hilctl.analysis.plot_style import DISPLACEMENT, QUIET, REFERENCE, STYLE
from hilctl.base.types import F64
from hilctl.comparison.compare import ComparedModel, Comparison, headings, notes, table_rows
from hilctl.identify.data.records import SteadyLoop

_COLUMNS = 6
_COLOURS = (
    "#D55E00", "#0072B2", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#882255", "#44AA99",
    "#999933",
)  # fmt: skip
_STYLES = ("-", "--", ":")


def comparison_page(comparison: Comparison) -> str:
    """Return the page as HTML."""
    body = [
        "<h1>Comparison of models</h1>",
        f'<p class="file">{html.escape(", ".join(comparison.sources))}</p>',
        grid(headings(comparison), table_rows(comparison), "numbers"),
        *(f"<p>{html.escape(note)}</p>" for note in notes(comparison)),
        grid(("model", "description"), [(row.name, row.title) for row in comparison.rows]),
        wide_figure("Errors against frequency, and loops", comparison_figure(comparison)),
    ]
    return document("Comparison of models", body)


@mpl.rc_context(STYLE)
def comparison_figure(comparison: Comparison) -> Figure:
    """Plot model and compensated errors over frequency, and measured and modelled loops."""
    shown = len(comparison.rows)
    lines = -(-shown // _COLUMNS)
    figure = Figure(figsize=(11.0, 4.2 + 2.3 * lines))
    upper, lower = figure.subfigures(2, 1, squeeze=False, height_ratios=[4.2, 2.3 * lines])[:, 0]
    _draw_errors(upper, comparison)
    number = _fastest(comparison.loops)
    panels = lower.subplots(lines, _COLUMNS, squeeze=False, sharex=True, sharey=True)
    for axes, row in zip(panels.flat, comparison.rows, strict=False):
        _draw_loop(axes, comparison.loops[number], row, number)
        axes.tick_params(labelbottom=True)
    for axes in panels.flat[shown:]:
        axes.set_axis_off()
    lower.suptitle(f"{comparison.loops[number].label}, measured (grey) and modelled", fontsize=10)
    return figure


def _fastest(loops: Sequence[SteadyLoop]) -> int:
    """Return the number of the largest of the fastest loops."""
    return max(
        range(len(loops)),
        key=lambda i: (round(loops[i].frequency_hz, 3), float(np.ptp(loops[i].displacement_um))),
    )


def _draw_errors(figure: SubFigure, comparison: Comparison) -> None:
    panels = figure.subplots(1, 2, sharey=True)
    model, compensated = panels
    for i, row in enumerate(comparison.rows):
        look = {
            "color": _COLOURS[(i - 1) % len(_COLOURS)] if i else REFERENCE,
            "linestyle": _STYLES[(i - 1) // len(_COLOURS) % len(_STYLES)] if i else "-",
            "marker": "o",
            "markersize": 3.0,
        }
        model.plot(*_largest(_model_points(comparison.loops, row)), label=row.name, **look)
        if row.trials:
            compensated.plot(*_largest(_trial_points(row)), **look)
    for axes in panels:
        axes.set(yscale="log", xlabel="frequency, Hz")
        axes.yaxis.set_major_formatter(lambda value, _: f"{value:g}")
    model.set(title="model", ylabel="peak error, % of peak-to-peak")
    compensated.set_title("compensated" if comparison.device else "compensated: no trials")
    figure.legend(loc="outside right upper")


def _model_points(loops: Sequence[SteadyLoop], row: ComparedModel) -> list[tuple[float, float]]:
    hz = [loop.frequency_hz for loop in loops]
    return list(zip(hz, (error.peak_percent for error in row.error.errors), strict=True))


def _trial_points(row: ComparedModel) -> list[tuple[float, float]]:
    return [
        (trial.frequency_hz, trial.peak_error_percent)
        for trial in row.trials
        if trial.peak_error_percent is not None
    ]


def _largest(points: list[tuple[float, float]]) -> tuple[F64, F64]:
    """Return unique frequencies with their largest errors: two float64[n]."""
    worst: dict[float, float] = {}
    for exact_hz, error in points:
        frequency_hz = round(exact_hz, 3)
        worst[frequency_hz] = max(error, worst.get(frequency_hz, 0.0))
    frequencies = sorted(worst)
    return np.array(frequencies), np.array([worst[f] for f in frequencies])


def _draw_loop(axes: Axes, loop: SteadyLoop, row: ComparedModel, number: int) -> None:
    modelled_um = row.error.modelled_um[number]
    axes.plot(_closed(loop.command), _closed(loop.displacement_um), color=QUIET, linewidth=2.0,
              alpha=0.5)  # fmt: skip
    axes.plot(_closed(loop.command), _closed(modelled_um), color=DISPLACEMENT, linewidth=0.9)
    axes.set_title(f"{row.name}: {row.error.errors[number].peak_percent:.1f} %", fontsize=8)


def _closed(values: F64) -> F64:
    return np.append(values, values[0])
