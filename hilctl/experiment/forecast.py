"""What a run will do, worked out by the same compensator that will run."""

import math
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from hilctl.base.arrays import F64
from hilctl.experiment.file import Experiment
from hilctl.experiment.load import LoadedExperiment
from hilctl.kernels.interlock import heat_block
from hilctl.loop.compensator import Compensator
from hilctl.loop.interlocks import warming
from hilctl.waveforms.build import Reference

_CHUNK = 1_000_000
_BYTES_A_SAMPLE = 45.0
_BYTES_OF_INPUT = 8.0


@dataclass(frozen=True, slots=True)
class Forecast:
    """What a run will do.

    Attributes:
        samples: Samples of the waveform.
        duration_s: Its length.
        reference_min: Lowest reference, in the waveform's unit.
        reference_max: Highest reference.
        command_unit: ``A`` or ``V``.
        command_min: Lowest command.
        command_max: Highest command.
        slew_per_s: Fastest change of the command.
        heating_rms_a: Highest running rms of the coil current, as the thermal budget has it; None
            where there is no budget.
        budget_used_s: Time after which the thermal budget is overdrawn; None where it is kept.
        recording_mb: About how large the recording will be.
        highest_rate_hz: Highest sample rate that the device can keep.
        rate_note: Why that is so; empty where there is no more to say.
    """

    samples: int
    duration_s: float
    reference_min: float
    reference_max: float
    command_unit: str
    command_min: float
    command_max: float
    slew_per_s: float
    heating_rms_a: float | None
    budget_used_s: float | None
    recording_mb: float
    highest_rate_hz: float
    rate_note: str

    def to_mapping(self) -> dict[str, Any]:
        """Return the fields as plain values."""
        return asdict(self)


def forecast_of(
    loaded: LoadedExperiment,
    reference: Reference,
    input_um: F64,
    state: F64 | None = None,
) -> Forecast:
    """Run the compensator on its input, and note what comes of it.

    Args:
        loaded: The experiment.
        reference: Every sample of its waveform.
        input_um: float64[n], the compensator's input.
        state: The compensator's memory at the start; at rest where None.

    Raises:
        ModelError: The model has no inverse.
    """
    config = loaded.config
    compensator = Compensator(loaded.model, config.sample_rate_hz)
    if state is not None:
        compensator.restore(state)
    heat = _Heat(config)
    last = config.safe.value
    low, high, step = last, last, 0.0
    values = reference.values
    wanted = np.empty(min(_CHUNK, input_um.size))
    for start in range(0, input_um.size, _CHUNK):
        part = input_um[start : start + _CHUNK]
        out = wanted[: part.size]
        compensator.process(part, out)
        with np.errstate(over="ignore", invalid="ignore"):  # what comes of it is refused
            steps = np.abs(np.diff(out, prepend=last))
        low = float(np.minimum(low, out.min()))  # keeps a NaN, where min() would lose it
        high = float(np.maximum(high, out.max()))
        step = float(np.maximum(step, steps.max()))
        last = float(out[-1])
        heat.add(out)
    byte_count = _BYTES_A_SAMPLE + (0.0 if input_um is reference.values else _BYTES_OF_INPUT)
    return Forecast(
        samples=values.size,
        duration_s=values.size / config.sample_rate_hz,
        reference_min=float(values.min()),
        reference_max=float(values.max()),
        command_unit=loaded.device.info.command_unit,
        command_min=low,
        command_max=high,
        slew_per_s=step * config.sample_rate_hz,
        heating_rms_a=heat.rms_a,
        budget_used_s=heat.used_s,
        recording_mb=values.size * byte_count / 1e6,
        highest_rate_hz=loaded.device.info.max_rate_hz,
        rate_note=loaded.device.info.rate_note,
    )


class _Heat:
    """Follows the thermal budget of the coil through the commands of a run."""

    def __init__(self, config: Experiment) -> None:
        limits = config.limits
        self._rate_hz = config.sample_rate_hz
        self._rms_a = limits.rms_current_a or math.inf
        self._tau_s = limits.thermal_time_constant_s
        self._heat = self._highest = config.safe.value**2
        self._samples = 0
        self.used_s: float | None = None

    def add(self, command: F64) -> None:
        """Go on with the next commands: float64[n], in A."""
        if self._tau_s is None:
            return
        heat = np.empty(command.size)
        self._heat = heat_block(command, warming(self._tau_s, self._rate_hz), self._heat, heat)
        over = np.flatnonzero(heat > self._rms_a**2)
        if self.used_s is None and over.size:
            self.used_s = (self._samples + int(over[0])) / self._rate_hz
        self._highest = max(self._highest, float(heat.max()))
        self._samples += command.size

    @property
    def rms_a(self) -> float | None:
        """Highest running rms of the current so far, in A; None without a thermal budget."""
        return None if self._tau_s is None else math.sqrt(self._highest)
