"""Loops, and what all fits need to know of them."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np

from hilctl.base.arrays import F64
from hilctl.base.device import CommandUnit
from hilctl.base.errors import DataError, InputError
from hilctl.identify.cycles import loops_from_recording
from hilctl.identify.data import Loop
from hilctl.identify.linear import bounded_weights
from hilctl.models.base import HysteresisModel
from hilctl.recording.data import Recording

Loops: TypeAlias = Sequence[Loop]

PERIODS = 3
"""Periods that a model is run through; the last is judged. Differential models forget slowly."""

LEAST_SLOPE = 0.01
"""Smallest slope that a fit may leave anywhere, relative to the data's mean slope."""

_BEYOND = 0.15


@dataclass(frozen=True, slots=True)
class Fitted:
    """A model that was found, and how many numbers were found for it."""

    model: HysteresisModel
    parameters: int


class Frame:
    """What all fits need to know of the loops.

    Attributes:
        loops: The loops.
        unit: Unit of the command.
        target_um: float64[N], measured displacement, loop after loop.
        command_range: Lowest and highest command.
        output_range_um: Lowest and highest displacement.
        command_span: The command's range and 15 % more, for inverses that need an end.
        reach: Half the largest peak-to-peak command.
        stroke_um: Largest peak-to-peak displacement of a loop.
    """

    def __init__(self, loops: Loops, unit: CommandUnit) -> None:
        """Look the loops over.

        Raises:
            DataError: There are none.
        """
        if not loops:
            raise DataError("nothing to compare models on: the list of loops is empty")
        self.loops = tuple(loops)
        self.unit = unit
        self.target_um = np.concatenate([loop.displacement_um for loop in loops])
        low = min(float(loop.command.min()) for loop in loops)
        high = max(float(loop.command.max()) for loop in loops)
        self.command_range = (low, high)
        self.output_range_um = (float(self.target_um.min()), float(self.target_um.max()))
        more = _BEYOND * 0.5 * (high - low)
        self.command_span = (low - more, high + more)
        self.reach = max(0.5 * float(np.ptp(loop.command)) for loop in loops)
        self.stroke_um = max(float(np.ptp(loop.displacement_um)) for loop in loops)

    @property
    def gain(self) -> float:
        """Largest stroke over largest peak-to-peak command, in um per command unit."""
        return self.stroke_um / (2.0 * self.reach)

    @property
    def least(self) -> float:
        """Smallest slope that a fit may leave, in um per command unit."""
        return LEAST_SLOPE * self.gain

    def stack(self, run: Callable[[F64], F64]) -> F64:
        """Run something on the loops' commands and stack the last period of each.

        Args:
            run: From a command, float64[n], to float64[n] or float64[n, m].

        Returns:
            float64[N] or float64[N, m].
        """
        parts = [run(np.tile(loop.command, PERIODS))[-loop.command.size :] for loop in self.loops]
        return np.concatenate(parts)

    def swing(self, columns: F64) -> F64:
        """Return how far each column, float64[N, m], moves within one loop at most: float64[m]."""
        ends = np.cumsum([loop.command.size for loop in self.loops])[:-1]
        parts = np.split(columns, ends)
        return np.asarray(np.max([np.ptp(part, axis=0) for part in parts], axis=0))

    def weigh(self, columns: F64, least: F64) -> tuple[F64, float]:
        """Fit ``columns w + c`` to the measured displacement, w >= least.

        Returns:
            Weights float64[m], and the constant displacement in um.
        """
        return bounded_weights(
            columns, self.target_um, np.ones(self.target_um.size), least, offset=True
        )

    def common(self, offset_um: float) -> dict[str, Any]:
        """Return the fields that every model has, by name."""
        return {
            "input_unit": self.unit,
            "input_range": self.command_range,
            "output_range_um": self.output_range_um,
            "output_offset_um": offset_um,
        }


def read_loops(recordings: Sequence[Recording], points: int) -> tuple[list[Loop], CommandUnit]:
    """Return the steady loops of recordings, and the unit of their commands.

    Args:
        recordings: At least one.
        points: Points a loop.

    Raises:
        DataError: One has no steady cycle.
        InputError: Devices driven in A and in V are mixed.
    """
    units = {recording.command_unit for recording in recordings}
    if len(units) != 1:
        raise InputError("recordings of devices driven in A and in V can't be compared on together")
    loops = [loop for recording in recordings for loop in loops_from_recording(recording, points)]
    return loops, units.pop()
