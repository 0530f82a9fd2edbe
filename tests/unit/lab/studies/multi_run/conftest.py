"""Synthetic runs of a report."""

from dataclasses import replace
from itertools import product
from typing import Any

import numpy as np
import pytest
from matplotlib.figure import Figure

from hilctl.lab.studies.multi_run.collect import RunSeries, SeriesRun
from hilctl.lab.studies.multi_run.digest import RunDigest, RunValues

PHASE = np.linspace(0.0, 2.0 * np.pi, 101)


def drawn(panel):
    axes = Figure().subplots()
    panel.draw(axes)
    return axes


def digest(*, compensated: bool = False, lag: float = 0.2, **keys: Any) -> RunDigest:
    """Return the digest of a sine of 40 um that lags."""
    moved = 40.0 * np.sin(PHASE - lag)
    wave = (40.0 if compensated else 6.0) * np.sin(PHASE)
    made = RunDigest(
        name="rig", path="run.mcap", started="2026-11-22T10:00:00+00:00", labels={},
        device="serial_dac", simulated=False, code="completed", reason="waveform completed",
        values={"waveform": {"unit": "A"}}, compensated=compensated, command_unit="A",
        waveform="sine", figures=RunValues(), loop=np.array((wave, moved)),
    )  # fmt: skip
    return replace(made, **keys)


def grown(amplitude: float, hz: float, number: int = 1, **keys: Any) -> SeriesRun:
    """Return a run whose area is linear in frequency and whose stroke is in amplitude."""
    figures = RunValues(
        peak_to_peak_um=10.0 * amplitude,
        loop_area=amplitude * (20.0 + 0.5 * hz),
        peak_hysteresis_percent=10.0 + 0.1 * hz,
        low_um=-6.0 * amplitude,
        high_um=4.0 * amplitude,
    )
    values = {"waveform.amplitude": amplitude, "waveform.frequency_hz": hz}
    made = SeriesRun(number, False, values, figures, "completed", f"run-{number}.mcap", digest())
    return replace(made, **keys)


@pytest.fixture
def crossed() -> RunSeries:
    """Return runs of two amplitudes by three frequencies."""
    points = product((3.0, 6.0), (10.0, 100.0, 200.0))
    runs = [grown(*point, number) for number, point in enumerate(points, 1)]
    return RunSeries("loops", tuple(runs), tuple(runs[0].values), is_campaign=True)


@pytest.fixture
def compensated() -> RunSeries:
    """Return runs without and with a compensator at two frequencies."""
    runs = []
    for name, percent in (("none", 20.0), ("omega", 2.0)):
        for hz in (1.0, 100.0):
            figures = RunValues(
                peak_hysteresis_percent=percent + 0.01 * hz,
                peak_error_percent=None if name == "none" else 1.0,
                peak_to_peak_um=80.0,
            )
            values = {"compensator": name, "waveform.frequency_hz": hz}
            found = digest(compensated=name != "none", lag=0.02, figures=figures)
            number = len(runs) + 1
            runs.append(grown(6.0, hz, number, figures=figures, values=values, digest=found))
    return RunSeries("before", tuple(runs), tuple(runs[0].values), is_campaign=True)
