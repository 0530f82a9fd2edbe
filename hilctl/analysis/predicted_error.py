"""The error that another model's inverse would have had, by what the recorded run has shown.

With commands u and displacements y of the run, a model's own displacement M(u) is off by y - M(u).
An exact inverse of it would put out commands with M(u') = reference, and so leave that very error,
as far as it is the same at u' as at u: to first order in u' - u. The noise of the sensor is in it,
as it is in the error that was recorded.
"""

import math
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from hilctl.base.samples import NO_WAVEFORM, Flag, Samples
from hilctl.base.types import F64
from hilctl.models.base import HysteresisModel


@dataclass(frozen=True, slots=True)
class PredictedError:
    """Errors on the samples of the waveform, in percent of their peak-to-peak displacement.

    Attributes:
        peak_percent: Largest that the other model would have left.
        rms_percent: Its root mean square.
        recorded_peak_percent: Largest that was recorded, on the same samples.
        recorded_rms_percent: Its root mean square.
    """

    peak_percent: float
    rms_percent: float
    recorded_peak_percent: float
    recorded_rms_percent: float

    def to_mapping(self) -> dict[str, Any]:
        """Return the fields as plain values."""
        return asdict(self)


class ErrorPrediction:
    """Goes through a run piece by piece: the model remembers, the errors are summed up.

    Args:
        model: The other model.
        sample_rate_hz: Rate of the run.
    """

    def __init__(self, model: HysteresisModel, sample_rate_hz: float) -> None:
        self._forward = model.forward(sample_rate_hz)
        self._low, self._high = math.inf, -math.inf
        self._count = 0
        self._peaks = np.zeros(2)
        self._squares = np.zeros(2)

    def add(self, samples: Samples) -> None:
        """Take what comes next; where samples are missing, the model holds what it had."""
        if not samples.index.size:
            return
        modelled = self._forward.process(np.ascontiguousarray(samples.command))
        displacement = samples.displacement_um
        judged = (samples.flags & np.uint32(NO_WAVEFORM | Flag.INVALID)) == 0
        judged &= np.isfinite(displacement) & np.isfinite(samples.reference_um)
        if not judged.any():
            return
        seen: F64 = displacement[judged]
        errors = np.stack((seen - modelled[judged], seen - samples.reference_um[judged]))
        self._low, self._high = min(self._low, seen.min()), max(self._high, seen.max())
        self._peaks = np.maximum(self._peaks, np.abs(errors).max(axis=1))
        self._squares += (errors**2).sum(axis=1)
        self._count += seen.size

    def result(self) -> PredictedError | None:
        """Return the errors; None where there was nothing to judge, or nothing moved."""
        span = self._high - self._low
        if self._count == 0 or span <= 0.0:
            return None
        peaks = (100.0 / span * self._peaks).tolist()
        rms = (100.0 / span * np.sqrt(self._squares / self._count)).tolist()
        return PredictedError(peaks[0], rms[0], peaks[1], rms[1])
