"""Bode plot, table and page of frequency responses."""

from collections.abc import Iterator, Sequence
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes

from hilctl.base.files import write_text
from hilctl.base.formatting import MISSING, quantity, significant, unit_text
from hilctl.lab.pages import html
from hilctl.lab.pages.figure_layout import FigureSpec, Panel
from hilctl.lab.pages.plot_style import (
    DISPLACEMENT,
    MARK,
    NAMED,
    REFERENCE,
    plain_numbers,
)
from hilctl.lab.response.frequency_response import FrequencyResponse

_MOST_ROWS = 24
_PARTS = (("magnitude", 0.62), ("phase", 0.45), ("coherence", 0.3))


def response_sheet(
    responses: Sequence[FrequencyResponse],
    names: Sequence[str] = (),
    colours: Sequence[str] = NAMED,
    band_hz: tuple[float, float] | None = None,
) -> FigureSpec:
    """Return magnitude, phase and coherence, measured (dots) and fitted (lines).

    Several responses have a name and a colour each. A band of frequencies is shaded.
    """

    def draw(axes: Axes, part: str) -> None:
        if band_hz:
            axes.axvspan(*band_hz, color="#eeeeee", zorder=0, label="band of the loops")
        for number, found in enumerate(responses):
            name = names[number] if names else ""
            _draw(axes, part, found, colours[number % len(colours)] if name else "", name)
        axes.set(xscale="log", xlabel="frequency, Hz")
        plain_numbers(axes)

    panels = tuple(Panel(partial(draw, part=part), height=height) for part, height in _PARTS)
    over = "; ".join(dict.fromkeys(signals_text(each) for each in responses))
    caption = f"Frequency response, {over}: measured (dots) and fitted (lines)."
    if len(responses) == 1 and (mode := responses[0].structure) is not None:
        damping = significant(mode.damping_ratio)
        caption += f" Resonance {quantity(mode.natural_hz, 'Hz')}, damping ratio {damping}."
    return FigureSpec("response", caption, panels, stacked=True)


def _draw(axes: Axes, part: str, found: FrequencyResponse, colour: str, name: str) -> None:
    hz = found.frequency_hz
    dots: dict[str, Any] = {
        "color": colour or DISPLACEMENT,
        "marker": ".",
        "markersize": 3.0,
        "linestyle": "",
    }
    line: dict[str, Any] = {
        "color": colour or REFERENCE,
        "linewidth": 0.9,
        "label": name or "fitted",
    }
    if not name:
        dots["label"] = "measured"
        if found.natural_hz is not None:
            axes.axvline(found.natural_hz, color=MARK, linestyle="--", label="resonance")
    if part == "magnitude":
        size = np.abs(found.response)
        axes.errorbar(hz, size, found.noise, fmt="none", ecolor=colour or DISPLACEMENT)
        axes.plot(hz, size, **dots)
        axes.plot(hz, np.abs(found.fitted), **line)
        axes.set_ylabel(f"magnitude, {unit_text(found.unit)}")
        low, high = axes.yaxis.get_data_interval()
        axes.set_yscale("log" if high > 3.0 * low > 0.0 else "linear")
    elif part == "phase":
        axes.plot(hz, found.phase_deg, **dots)
        fitted = np.degrees(np.unwrap(np.angle(found.fitted)))
        turns = np.round((fitted[0] - found.phase_deg[0]) / 360.0)
        axes.plot(hz, fitted - 360.0 * turns, **line)
        axes.set_ylabel("phase, °")
    else:
        axes.plot(hz, found.coherence, **dots)
        axes.set(ylabel="coherence", ylim=(0.0, 1.05))


def signals_text(found: FrequencyResponse) -> str:
    """Return input and output in words."""
    sent, answered = found.signals.split("-")
    return f"{sent} to {'measured command' if answered == 'measured' else answered}"


def fit_rows(found: FrequencyResponse) -> Iterator[tuple[str, str]]:
    """Yield results with their standard errors, each as name and text."""
    yield "signals", signals_text(found)
    yield "excitation", f"{found.excitation}, {found.averages} {_COUNTED[found.method]}"
    yield "frequencies", f"{found.frequency_hz.size} of {found.excited_lines} above the noise"

    def measured(name: str, unit: str = "") -> str:
        error = quantity(found.errors.get(name), unit, 2)
        return f"{quantity(getattr(found, name), unit, 4)} ± {error}"

    yield "gain", measured("gain_um", found.unit)
    yield "delay", measured("delay_s", "s")
    yield "lag", measured("lag_s", "s") if found.lag_s else MISSING
    if found.natural_hz is not None:
        yield "natural frequency", measured("natural_hz", "Hz")
        yield "damping ratio", measured("damping_ratio")
        yield "quality factor", quantity(found.quality)
    for mode in found.further:
        at = f"{quantity(mode.natural_hz, 'Hz', 4)}, damping ratio {quantity(mode.damping_ratio)}"
        yield "further mode", f"{at}; antiresonance {quantity(mode.antiresonance_hz, 'Hz', 4)}"
    bandwidth = f"above {quantity(float(found.frequency_hz[-1]), 'Hz')}"
    if found.bandwidth_hz is not None:
        bandwidth = quantity(found.bandwidth_hz, "Hz", 4)
    yield "-3 dB bandwidth", bandwidth
    middle, lowest = (significant(float(f(found.coherence)), 4) for f in (np.median, np.min))
    yield "coherence", f"median {middle}, lowest {lowest}"
    yield "residual of the fit", f"{quantity(found.misfit_percent, '%')} rms of the gain"
    if (free := found.free) is not None:
        parts = asdict(free).items()
        texts = (f"{name.partition('_')[0]} {quantity(value, '%', 2)}" for name, value in parts)
        yield "lines not excited", ", ".join(texts)


_COUNTED = {"periods": "periods", "averaged spectra": "averages", "sines": "cycles or more"}


def line_table(found: FrequencyResponse) -> tuple[tuple[str, ...], list[tuple[str, ...]]]:
    """Return headings and rows of at most 24 frequencies."""
    size_heading = f"magnitude, {unit_text(found.unit)}"
    headings = ("frequency, Hz", size_heading, "relative, dB", "phase, °", "coherence")
    hz, size, phase_deg = found.frequency_hz, np.abs(found.response), found.phase_deg
    wanted = np.geomspace(hz[0], hz[-1], _MOST_ROWS)
    shown = np.unique([int(np.argmin(np.abs(np.log(hz / each)))) for each in wanted])
    relative = 20.0 * np.log10(size / abs(found.gain_um))
    return headings, [
        (
            f"{hz[k]:.6g}",
            significant(float(size[k]), 4),
            f"{relative[k]:z.2f}",
            f"{phase_deg[k]:z.1f}",
            f"{found.coherence[k]:.4f}",
        )
        for k in shown
    ]


def write_responses(responses: Sequence[FrequencyResponse], path: Path) -> None:
    """Write the page of one or several responses; an existing file is replaced."""
    names = [each.path.stem for each in responses] if len(responses) > 1 else []
    tables = zip(names or ["value"], map(fit_rows, responses), strict=True)
    lines = [html.section(each.path.stem, html.grid(*line_table(each))) for each in responses]
    body = [
        html.paragraph(", ".join(str(each.path) for each in responses), "file"),
        *html.results([response_sheet(responses, names)], "Fit", list(tables), lines),
        html.definitions("coherence", "lines not excited"),
    ]
    write_text(path, html.document("Frequency response", body), overwrite=True)
