"""What comes before a waveform: a cycle to a repeatable state, and the resting displacement.

The cycle's commands are worked out before the run and pass the limiter as all others do. Where it
has ended the output rests at the safe value, and the mean displacement there is held against the
model's: the offset between both is taken out of the compensator's input from then on, so that a
sensor or an actuator that has moved since the model was identified costs no error.
"""

import math
from dataclasses import dataclass

import numpy as np

from hilctl.base.types import F64


@dataclass(frozen=True, slots=True)
class Conditioning:
    """What comes before a waveform.

    Attributes:
        command: float64[m], wanted commands, whole blocks; the last of them rest at the safe value.
        rest: First and after the last of them in which the displacement rests. Those after it are
            as many as the device needs to answer these.
        cycle_samples: How many of them the cycle takes; 0 where there is only rest.
        stands_um: Displacement at rest by the model; None where no offset is measured.
        largest_um: Largest offset that is taken out.
        lead_in: Samples of the waveform over which it is.
    """

    command: F64
    rest: tuple[int, int]
    cycle_samples: int
    stands_um: float | None = None
    largest_um: float = math.inf
    lead_in: int = 1


class RestingOffset:
    """Measures how far the sensor stands from the model, and takes that out of the input.

    Args:
        conditioning: What comes before the waveform.
        begins_at: Sample at which that begins.
    """

    def __init__(self, conditioning: Conditioning, begins_at: int) -> None:
        first, stop = conditioning.rest
        self._first, self._stop = begins_at + first, begins_at + stop
        self._sum_um, self._count = 0.0, 0
        self._about_um, self._square_um2 = math.nan, 0.0
        self._offset_um = 0.0
        way = np.arange(1, conditioning.lead_in + 1) / conditioning.lead_in
        self._rise: F64 = 0.5 * (1.0 - np.cos(np.pi * way))

    def take(self, first_sample: int, displacement_um: F64) -> None:
        """Take the displacements of a block, float64[B]; those that are not at rest are left."""
        low, high = self._first - first_sample, self._stop - first_sample
        if low < displacement_um.size and high > 0:
            resting = displacement_um[max(low, 0) : high]
            self._sum_um += float(resting.sum())
            if not self._count:
                self._about_um = resting.item(0)
            # About the first of them: squares of the displacement itself would hide the noise.
            self._square_um2 += float(np.square(resting - self._about_um).sum())
            self._count += resting.size

    @property
    def resting_um(self) -> float:
        """Mean displacement at rest; NaN where none has come."""
        return self._sum_um / self._count if self._count else math.nan

    @property
    def noise_um(self) -> float:
        """Standard deviation of the displacement at rest; NaN where none has come."""
        if not self._count:
            return math.nan
        mean_um = self.resting_um - self._about_um
        return math.sqrt(max(0.0, self._square_um2 / self._count - mean_um**2))

    def take_out(self, offset_um: float) -> None:
        """Take an offset out of the input from now on."""
        self._offset_um = offset_um

    def apply(self, input_um: F64, start: int) -> None:
        """Correct the input (float64[n]) of the waveform's samples from ``start`` on, in place.

        It comes in over the lead-in: where the compensator begins, its input is what the model has
        there.
        """
        if not self._offset_um:
            return
        rising = self._rise[start : start + input_um.size]
        input_um[: rising.size] -= self._offset_um * rising
        input_um[rising.size :] -= self._offset_um
