"""What a run goes through before its waveform: where that begins, and what is recorded of it.

A ramp from where the output was to the safe value, then the conditioning where the plan has one,
then the waveform, whose input is without the offset that was measured at rest.
"""

import math
from typing import TypeAlias

from hilctl.base.events import Event
from hilctl.base.types import F64
from hilctl.loop.conditioning import Conditioning, RestingOffset

Finding: TypeAlias = tuple[str, dict[str, float], bool]
"""What was found, in words, empty for nothing; its numbers; whether the run must end for it."""


class LeadIn:
    """What comes before the waveform of one run.

    Args:
        conditioning: What comes after the ramp; None for nothing.
        ramp_samples: Samples of the ramp to the safe value, whole blocks.
    """

    def __init__(self, conditioning: Conditioning | None, ramp_samples: int) -> None:
        self.condition_at = self.waveform_at = ramp_samples
        """Sample at which the conditioning begins, and the one at which the waveform does."""
        self._conditioning = conditioning
        self._resting: RestingOffset | None = None
        if conditioning is not None:
            self.waveform_at += conditioning.command.size
            self._resting = RestingOffset(conditioning, self.condition_at)

    def ramp_event(self, output: float, safe: float) -> Event:
        """Return the event of a ramp from where the output was to the safe value."""
        values = {"output": output, "samples": float(self.condition_at)}
        text = f"output was at {output:g}: ramp to {safe:g} first"
        return Event(0, "info", "start_ramp", text, values)

    def condition_event(self) -> Event | None:
        """Return the event of the conditioning cycle; None where there is none."""
        conditioning = self._conditioning
        if conditioning is None or not conditioning.cycle_samples:
            return None
        cycle, rest = conditioning.cycle_samples, conditioning.command.size
        text = f"conditioning cycle of {cycle} samples, {rest} with the rest after it"
        values = {"cycle_samples": float(cycle), "samples": float(rest)}
        return Event(self.condition_at, "info", "condition", text, values)

    def condition(self, wanted: F64, sample: int) -> None:
        """Fill wanted commands (float64[n]) of the conditioning, from ``sample`` of the run on."""
        assert self._conditioning is not None
        start = sample - self.condition_at
        wanted[:] = self._conditioning.command[start : start + wanted.size]

    def take(self, first_sample: int, displacement_um: F64) -> None:
        """Take the displacements of a block, float64[B], of any part of the run."""
        if self._resting is not None:
            self._resting.take(first_sample, displacement_um)

    def take_offset_out(self) -> Finding:
        """Hold the resting displacement against the model's, and take the difference out.

        Beyond the limit the run must end, and nothing is taken out.
        """
        conditioning, resting = self._conditioning, self._resting
        if conditioning is None or resting is None or conditioning.stands_um is None:
            return "", {}, False
        stands_um, measured_um = conditioning.stands_um, resting.resting_um
        offset_um = measured_um - stands_um
        values = {"offset_um": offset_um, "resting_um": measured_um, "model_um": stands_um}
        rests = f"at rest the sensor shows {measured_um:.4g} µm, the model {stands_um:.4g} µm"
        if not abs(offset_um) <= conditioning.largest_um:
            limit = f"an offset beyond {conditioning.largest_um:.4g} µm"
            return f"{rests}: {limit}: identify the model anew", values, True
        resting.take_out(offset_um)
        text = f"{rests}: {offset_um:.4g} µm are taken out of the compensator's input"
        return text, values, False

    @property
    def noise_um(self) -> float:
        """Standard deviation of the displacement at rest; NaN where it has not rested."""
        return math.nan if self._resting is None else self._resting.noise_um

    def correct(self, input_um: F64, start: int) -> None:
        """Take the measured offset out of the input (float64[n]) from ``start`` of the waveform."""
        if self._resting is not None:
            self._resting.apply(input_um, start)
