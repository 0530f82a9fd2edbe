"""The straight line that takes the inverse's place while it is out: the same ends, no hysteresis.

It leads from the lowest to the highest command that the compensator gives over the waveform, so
that the actuator makes the same stroke, and what is left between the two is what the inverse does.
"""

import math

import numpy as np

from hilctl.base.types import F64
from hilctl.experiment.load import LoadedExperiment
from hilctl.loop.tuning import LinearBypass


class LineEnds:
    """Gathers where the line begins and ends, from references and commands as they come."""

    def __init__(self) -> None:
        self._low, self._high = (math.inf, math.nan), (-math.inf, math.nan)
        self._lowest, self._highest = math.inf, -math.inf

    def add(self, reference: F64, command: F64) -> None:
        """Take the next ones: float64[n] each, n > 0."""
        low, high = int(reference.argmin()), int(reference.argmax())
        self._low = min(self._low, (float(reference[low]), float(command[low])))
        self._high = max(self._high, (float(reference[high]), float(command[high])))
        self._lowest = float(np.minimum(self._lowest, command.min()))
        self._highest = float(np.maximum(self._highest, command.max()))

    def line(self) -> LinearBypass | None:
        """Return the line; None where the reference stands still, or a command is no number."""
        (low_um, at_low), (high_um, at_high) = self._low, self._high
        rise = self._highest - self._lowest
        if not (high_um > low_um and math.isfinite(rise)):
            return None
        # On some wings a displacement rises where the command falls.
        slope = math.copysign(rise, at_high - at_low) / (high_um - low_um)
        middle_um = 0.5 * (low_um + high_um)
        return LinearBypass(slope, 0.5 * (self._lowest + self._highest) - slope * middle_um)


def fade_refusal(loaded: LoadedExperiment, line: LinearBypass | None, wanted: str) -> str:
    """Return why the inverse can't go out or in, or an empty text.

    Args:
        loaded: The experiment.
        line: Its straight line.
        wanted: ``in`` or ``out``.
    """
    if loaded.model is None:
        return "the experiment has no compensator: there is no inverse to take out"
    if line is None:
        return "the reference stands still: there is no straight line through its ends"
    if wanted == "out" and loaded.config.limits.tracking_error_um is not None:
        return (
            "limits.tracking_error_um ends a run whose displacement leaves its reference, and a "
            "straight line leaves all hysteresis in: take it out of the experiment first"
        )
    return ""
