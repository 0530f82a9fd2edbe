"""Causes of a large model error in the data, each named only if its removal halves the error."""

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import TypeAlias

import numpy as np
from scipy.ndimage import median_filter

from hilctl.base.types import F64
from hilctl.lab.identify.data.data_faults import record_fault
from hilctl.lab.identify.data.records import Record, SteadyLoop, turning_points
from hilctl.lab.identify.fit_model import FittedModel
from hilctl.lab.identify.settings import FitSettings
from hilctl.signals.cycle_metrics import MAD_TO_SIGMA, rms

Refit: TypeAlias = Callable[[Sequence[Record]], tuple[float, float] | None]
"""Returns the rms error, on held-out parts if any, and that of a new fit to changed records."""

HALF = 0.5  # of an rms error: the largest one without its cause
DRIFT, FEWEST_TURNS = 0.02, 6  # smallest drift, of the stroke, and turns that show it
STEADY = 1.5  # largest ratio of the drifts of two halves, or of two loops
SPIKE, AROUND, MOST_SPIKES = 8.0, 5, 0.05  # of the noise; samples compared with; share of samples


def error_um(fit: FittedModel, number: int, record: Record) -> F64:
    """Return the error of a fit on the evaluated samples of a record: float64[n]."""
    modelled = fit.modelled_um[number]
    return modelled - record.displacement_um[-modelled.size :]


def cause_of(
    fit: FittedModel,
    records: Sequence[Record],
    settings: FitSettings,
    refit: Refit,
) -> str:
    """Return the fault of the data that explains most of a large error; empty if none does."""
    for record in records:
        if text := record_fault(record, settings):
            return f"'{record.label}' {text}"
    errors_um = [error_um(fit, i, record) for i, record in enumerate(records)]
    return _spikes_or_noise(errors_um, records) or _drift(errors_um, records, refit)


def _spikes_or_noise(errors_um: Sequence[F64], records: Sequence[Record]) -> str:
    smooth_um = [median_filter(each, AROUND, mode="nearest") for each in errors_um]
    rough_um = [each - smooth for each, smooth in zip(errors_um, smooth_um, strict=True)]
    total_um = rms(np.concatenate(errors_um))
    noise_um = MAD_TO_SIGMA * float(np.median(np.abs(np.concatenate(rough_um))))
    spikes = [np.abs(each) > max(SPIKE * noise_um, total_um) for each in rough_um]
    count = sum(map(np.count_nonzero, spikes))
    clean_um = [
        np.where(found, smooth, each)
        for found, smooth, each in zip(spikes, smooth_um, errors_um, strict=True)
    ]
    share = count / sum(each.size for each in errors_um)
    if 0.0 < share < MOST_SPIKES and rms(np.concatenate(clean_um)) < HALF * total_um:
        largest = int(np.argmax([np.max(np.abs(each)) for each in rough_um]))
        record, at = records[largest], int(np.argmax(np.abs(rough_um[largest])))
        at += record.command.size - rough_um[largest].size
        when = f"point {at + 1}"
        if not isinstance(record, SteadyLoop):
            when = f"{record.time_s[at]:.4g} s"
        return (
            f"most of the error is {count} spikes; the largest is in '{record.label}' at {when}: "
            "remove these values (NaN or an empty cell), or measure again"
        )
    # The difference of neighbours has twice the variance of white noise, and little of the rest.
    noise_um2 = 0.5 * float(np.var(np.concatenate([np.diff(each) for each in errors_um])))
    if total_um**2 - noise_um2 > (HALF * total_um) ** 2:
        return ""
    return (
        f"most of the error is sensor noise, {math.sqrt(noise_um2):.2g} µm rms: the "
        "model may be better; measure again with less noise"
    )


def _drift(errors_um: Sequence[F64], records: Sequence[Record], refit: Refit) -> str:
    """Return a message if the error halves without a steady drift of the displacement."""
    loops = [record for record in records if isinstance(record, SteadyLoop)]
    slopes = [_slope(*each) for each in zip(errors_um, records, strict=True)]
    if loops:
        slopes = [_slope_of_loops(loops)] * len(records)
    if not any(slopes):
        return ""
    errors = refit([_without(*each) for each in zip(records, slopes, strict=True)])
    if errors is None or errors[1] > HALF * errors[0]:
        return ""
    largest = int(np.argmax(np.abs(slopes)))
    where = "the displacement" if loops else f"'{records[largest].label}'"
    return (
        f"{where} drifts by about {slopes[largest]:.2g} µm/s; without it the error is "
        f"{errors[1]:.2g} % rms instead of {errors[0]:.2g} %: subtract it, or measure again with a "
        "warm sensor and actuator"
    )


def _without(record: Record, slope: float) -> Record:
    time_s = record.start_s if isinstance(record, SteadyLoop) else record.time_s
    return replace(record, displacement_um=record.displacement_um - slope * time_s)


def _slope(error: F64, record: Record) -> float:
    """Return the drift of a history in µm/s; 0 if it is small, or not the same in both halves."""
    if isinstance(record, SteadyLoop):
        return 0.0
    first = record.command.size - error.size
    turns = turning_points(record.command[first:])
    signals = [(record.time_s[first:], -error)]
    if turns.size > FEWEST_TURNS:
        # A model of decaying motions hides drift, which the middles of their swings show. These
        # also move with the amplitude if the actuator is asymmetric.
        time_s, middles, middles_um = (
            0.5 * (each[first:][turns][1:] + each[first:][turns][:-1])
            for each in (record.time_s, record.command, record.displacement_um)
        )
        line = np.stack((middles, np.ones_like(middles)), axis=1)
        signals.append((time_s, middles_um - line @ np.linalg.lstsq(line, middles_um)[0]))
    for time_s, off_um in signals:
        half = off_um.size // 2
        slope, early, late = (
            float(np.polyfit(time_s[part], off_um[part], 1)[0])
            for part in (slice(None), slice(half), slice(half, None))
        )
        large = abs(slope) * np.ptp(time_s) > DRIFT * np.ptp(record.displacement_um)
        # Creep becomes slower.
        if large and 1.0 / STEADY < early / late < STEADY:
            return slope
    return 0.0


def _slope_of_loops(loops: Sequence[SteadyLoop]) -> float:
    """Return the drift that all loops have in µm/s; 0 if they differ, as with creep."""
    slopes = np.array([loop.drift_um_per_s for loop in loops])
    low, middle, high = np.percentile(slopes, (25.0, 50.0, 75.0)).tolist()
    return middle if low * high > 0.0 and 1.0 / STEADY < low / high < STEADY else 0.0
