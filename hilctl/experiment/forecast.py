"""What a run will do, worked out by the same compensator that will run."""

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from hilctl.base.arrays import F64
from hilctl.experiment.interlocks import HeatForecast
from hilctl.experiment.load import LoadedExperiment
from hilctl.loop.compensator import Compensator
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
    heat: HeatForecast,
    state: F64 | None = None,
) -> Forecast:
    """Run the compensator on its input, and note what comes of it.

    Args:
        loaded: The experiment.
        reference: Every sample of its waveform.
        input_um: float64[n], the compensator's input.
        heat: Follows the coil's heat.
        state: The compensator's memory at the start; at rest where None.

    Raises:
        ModelError: The model has no inverse.
    """
    config = loaded.config
    compensator = Compensator(loaded.model, config.sample_rate_hz)
    if state is not None:
        compensator.restore(state)
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
        recording_mb=values.size * byte_count / 1e6,
        highest_rate_hz=loaded.device.info.max_rate_hz,
        rate_note=loaded.device.info.rate_note,
    )
