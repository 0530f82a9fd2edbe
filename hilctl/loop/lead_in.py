"""The lead-in of a waveform: initial ramp, conditioning cycle, and offset at rest.

The commands of the conditioning cycle are computed before the run, and pass the limiter. After the
cycle the output rests at the safe value. The mean displacement at rest is compared with the
model's, and the offset is subtracted from the compensator's input: so a shift of sensor or actuator
since the identification causes no error. For a sensor without a defined zero the offset is
subtracted from the readings instead, and the actuator does not move.
"""

import math
from dataclasses import dataclass

import numpy as np

from hilctl.base.events import Event
from hilctl.base.types import F64


@dataclass(frozen=True, slots=True)
class Conditioning:
    """Commands before a waveform, and parameters for measuring the offset at rest.

    Attributes:
        command: float64[m], requested commands, whole blocks; the last commands are the safe value.
        rest: Start and stop of the samples at rest; later samples cover the device's latency.
        cycle_samples: Samples of the cycle; 0 if there is only rest.
        stands_um: The model's displacement at rest, 0 without a model; None if no offset is
            measured.
        largest_um: Largest offset that is removed.
        lead_in: Samples of the waveform over which the correction fades in.
        zero: Whether the offset is subtracted from the readings.
    """

    command: F64
    rest: tuple[int, int]
    cycle_samples: int
    stands_um: float | None = None
    largest_um: float = math.inf
    lead_in: int = 1
    zero: bool = False


class LeadIn:
    """Samples of a run before its waveform: ramp or rest in whole blocks, then the conditioning.

    At rest it measures the offset between sensor and model, which is then subtracted from the
    compensator's input or from the readings.
    """

    def __init__(self, conditioning: Conditioning | None, condition_at: int) -> None:
        self.condition_at = condition_at
        """First sample of the conditioning."""
        self._conditioning = conditioning
        self._rest = 0, 0
        self._sum_um, self._count = 0.0, 0
        self._about_um, self._square_um2 = math.nan, 0.0
        self._offset_um = 0.0
        self.zero_um: float | None = None
        """Offset that is subtracted from the readings; None without one."""
        if conditioning is not None:
            first, stop = conditioning.rest
            self._rest = condition_at + first, condition_at + stop
            way = np.arange(1, conditioning.lead_in + 1) / conditioning.lead_in
            self._rise: F64 = 0.5 * (1.0 - np.cos(np.pi * way))

    def condition_event(self) -> Event | None:
        """Return the event of the conditioning cycle; None without one."""
        conditioning = self._conditioning
        if conditioning is None or not conditioning.cycle_samples:
            return None
        cycle, rest = conditioning.cycle_samples, conditioning.command.size
        text = f"conditioning cycle of {cycle} samples, {rest} with the rest after it"
        values = {"cycle_samples": float(cycle), "samples": float(rest)}
        return Event(self.condition_at, "info", "condition", text, values)

    def condition(self, wanted: F64, sample: int) -> None:
        """Fill in requested commands, float64[n], beginning with sample ``sample`` of the run."""
        assert self._conditioning is not None
        start = sample - self.condition_at
        wanted[:] = self._conditioning.command[start : start + wanted.size]

    def take(self, first_sample: int, displacement_um: F64) -> None:
        """Add the displacements of a block at rest, float64[B]; zero those of a later block."""
        if self.zero_um is not None:
            displacement_um -= self.zero_um
            return
        low, high = self._rest[0] - first_sample, self._rest[1] - first_sample
        if low < displacement_um.size and high > 0:
            resting = displacement_um[max(low, 0) : high]
            resting = resting[~np.isnan(resting)]  # readings that the device marks as invalid
            if not resting.size:
                return
            self._sum_um += float(resting.sum())
            if not self._count:
                self._about_um = resting.item(0)
            # Relative to the first sample: squares of the displacement itself would hide the noise.
            self._square_um2 += float(np.square(resting - self._about_um).sum())
            self._count += resting.size

    def remove_offset(self) -> tuple[str, dict[str, float], bool]:
        """Compare the resting displacement with the model's, and remove the difference.

        Returns:
            Text (empty if nothing was measured), values, and whether the run must end because the
            offset exceeds the limit.
        """
        conditioning = self._conditioning
        if conditioning is None or conditioning.stands_um is None:
            return "", {}, False
        stands_um, measured_um = conditioning.stands_um, self.resting_um
        offset_um = measured_um - stands_um
        values = {"offset_um": offset_um, "resting_um": measured_um, "model_um": stands_um}
        rests = f"at rest the sensor shows {measured_um:.4g} µm, the model {stands_um:.4g} µm"
        zero = conditioning.zero
        if not abs(offset_um) <= conditioning.largest_um:
            limit = f"an offset beyond {conditioning.largest_um:.4g} µm"
            cure = "adjust the sensor" if zero else "identify the model again"
            return f"{rests}: {limit}: {cure}", values, True
        target = "readings" if zero else "compensator's input"
        if zero:
            self.zero_um = offset_um
        else:
            self._offset_um = offset_um
        return f"{rests}: {offset_um:.4g} µm are subtracted from the {target}", values, False

    @property
    def resting_um(self) -> float:
        """Mean displacement at rest; NaN without samples."""
        return self._sum_um / self._count if self._count else math.nan

    @property
    def noise_um(self) -> float:
        """Standard deviation of the displacement at rest; NaN without samples."""
        if not self._count:
            return math.nan
        mean_um = self.resting_um - self._about_um
        return math.sqrt(max(0.0, self._square_um2 / self._count - mean_um**2))

    def correct(self, input_um: F64, start: int) -> None:
        """Subtract the measured offset from the input (float64[n]) from sample ``start`` on.

        The correction fades in, so that the compensator starts with the model's value.
        """
        if not self._offset_um:
            return
        rising = self._rise[start : start + input_um.size]
        input_um[: rising.size] -= self._offset_um * rising
        input_um[rising.size :] -= self._offset_um
