"""How far a model is from loops, and how long one of its samples takes."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.interpolate import CubicSpline

from hilctl.base.arrays import F64
from hilctl.comparison.data import PERIODS, Loops
from hilctl.identify.data import Loop
from hilctl.models.base import HysteresisModel

TIMED_SAMPLES = 20_000
_ROUNDS = 5


@dataclass(frozen=True, slots=True)
class LoopFigures:
    """A model beside one measured loop.

    Attributes:
        label: The loop's.
        frequency_hz: The loop's.
        peak_to_peak_um: The loop's own displacement.
        peak_percent: Largest displacement error, in percent of the loop's own peak-to-peak.
        rms_percent: Root mean square error, in percent of the same.
        modelled_um: float64[M], the model's displacement at the loop's points.
    """

    label: str
    frequency_hz: float
    peak_to_peak_um: float
    peak_percent: float
    rms_percent: float
    modelled_um: F64


@dataclass(frozen=True, slots=True)
class ModelError:
    """How far a model is from all loops.

    Attributes:
        peak_percent: Largest displacement error of all, in percent of the largest peak-to-peak
            displacement of a loop.
        rms_percent: Root mean square error of all, in percent of the same.
        loops: One for each loop.
    """

    peak_percent: float
    rms_percent: float
    loops: tuple[LoopFigures, ...]


def response_um(model: HysteresisModel, loop: Loop) -> F64:
    """Return what a model gives for a loop's command in its steady state.

    The model runs as it would in a run: at the rate of the run that the loop is from, sample by
    sample, for a few periods from rest. Where that rate is not known, each point is a sample.

    Args:
        model: Any model.
        loop: The loop.

    Returns:
        float64[M], in um, at the loop's points.
    """
    points = loop.command.size
    rate_hz = loop.sample_rate_hz or points * loop.frequency_hz
    phase = np.arange(points + 1) / points
    spline = CubicSpline(phase, np.append(loop.command, loop.command[0]), bc_type="periodic")
    samples = int(np.ceil(PERIODS * rate_hz / loop.frequency_hz)) + 2
    periods = np.arange(samples) * (loop.frequency_hz / rate_hz)
    response = model.forward(rate_hz).process(np.ascontiguousarray(spline(periods)))
    return np.asarray(np.interp(PERIODS - 1.0 + phase[:-1], periods, response), dtype=np.float64)


def model_error(model: HysteresisModel, loops: Loops) -> ModelError:
    """Work out a model's errors on loops, those it was fitted to or others."""
    figures, errors = [], []
    for loop in loops:
        modelled_um = response_um(model, loop)
        error_um = modelled_um - loop.displacement_um
        swing = float(np.ptp(loop.displacement_um))
        errors.append(error_um)
        figures.append(
            LoopFigures(
                label=loop.label,
                frequency_hz=loop.frequency_hz,
                peak_to_peak_um=swing,
                peak_percent=100.0 * float(np.max(np.abs(error_um))) / swing,
                rms_percent=100.0 * float(np.sqrt(np.mean(error_um**2))) / swing,
                modelled_um=modelled_um,
            )
        )
    everything = np.concatenate(errors)
    to_percent = 100.0 / max(figure.peak_to_peak_um for figure in figures)
    return ModelError(
        peak_percent=float(np.max(np.abs(everything))) * to_percent,
        rms_percent=float(np.sqrt(np.mean(everything**2))) * to_percent,
        loops=tuple(figures),
    )


def inverse_ns(
    model: HysteresisModel, loop: Loop, sample_rate_hz: float, clock: Callable[[], float]
) -> float:
    """Measure what one sample of a model's inverse takes, in ns.

    The reference is a sine of the loop's stroke and frequency; the shortest of some rounds counts,
    because whatever else the machine does only adds to it.

    Args:
        model: Any model.
        loop: Gives stroke and frequency.
        sample_rate_hz: Samples a second.
        clock: Time in s.
    """
    low, high = float(loop.displacement_um.min()), float(loop.displacement_um.max())
    angle = 2.0 * np.pi * loop.frequency_hz / sample_rate_hz * np.arange(TIMED_SAMPLES)
    reference_um = 0.5 * (low + high) + 0.5 * (high - low) * np.sin(angle)
    operator = model.inverse(sample_rate_hz)
    out = np.empty_like(reference_um)
    operator.process(reference_um, out)
    times = []
    for _ in range(_ROUNDS):
        begin = clock()
        operator.process(reference_um, out)
        times.append(clock() - begin)
    return 1e9 * min(times) / TIMED_SAMPLES
