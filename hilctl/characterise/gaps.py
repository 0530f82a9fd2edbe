"""What a run has skipped, filled in: meanwhile the actuator held the last command."""

import numpy as np

from hilctl.base.arrays import F64
from hilctl.base.errors import DataError
from hilctl.recording.data import Recording

MOST_MISSING = 0.01
"""Largest part of the samples that may be missing; a run that skips more ends by itself."""


def without_gaps(recording: Recording, start: int, stop: int) -> tuple[F64, F64]:
    """Return every command and displacement between two samples, those skipped included.

    Args:
        recording: A run.
        start: Index of the first sample.
        stop: Index after the last.

    Returns:
        Command, held where samples are missing, and displacement in um, straight lines there:
        float64[stop - start] each.

    Raises:
        DataError: More than 1 % of them are missing or have no displacement.
    """
    samples = recording.samples.part(start, stop)
    wanted = np.arange(start, stop)
    good = np.isfinite(samples.displacement_um)
    missing = wanted.size - np.count_nonzero(good)
    if missing > MOST_MISSING * wanted.size:
        rule = f"{missing} of {wanted.size} samples are missing or have no displacement"
        raise DataError(f"{recording.path}: {rule}: look at late ticks and at the sensor")
    last = np.maximum(np.searchsorted(samples.index, wanted, side="right") - 1, 0)
    displacement_um = np.interp(wanted, samples.index[good], samples.displacement_um[good])
    return np.ascontiguousarray(samples.command[last]), displacement_um
