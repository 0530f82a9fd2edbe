"""What a run will do, worked out by the same compensator that will run."""

import math
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from hilctl.base.arrays import F64
from hilctl.experiment.file import Experiment
from hilctl.experiment.heat import CoilHeat, RunHeat
from hilctl.experiment.initial_state import Begun
from hilctl.experiment.load import LoadedExperiment
from hilctl.experiment.straight import LineEnds
from hilctl.loop.compensator import Compensator
from hilctl.loop.host import StraightLine
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
        before_s: Time of the conditioning before it.
        begins: Where the compensator begins, in words; empty without one.
        reference_min: Lowest reference, in the waveform's unit.
        reference_max: Highest reference.
        command_unit: ``A`` or ``V``.
        command_min: Lowest command.
        command_max: Highest command.
        slew_per_s: Fastest change of the command.
        heat: What it does to the heat of the coil, whatever that is before.
        begins_rms_a: Running rms of the coil current that it begins with, by what the last run of
            the device left; None where there is no budget.
        heating_rms_a: Highest running rms of the coil current, as the thermal budget has it; None
            where there is no budget.
        budget_used_s: Time after which the thermal budget is overdrawn; None where it is kept.
        recording_mb: About how large the recording will be.
        highest_rate_hz: Highest sample rate that the device can keep.
        rate_note: Why that is so; empty where there is no more to say.
        line: What can take the inverse's place; None where nothing can.
    """

    samples: int
    duration_s: float
    before_s: float
    begins: str
    reference_min: float
    reference_max: float
    command_unit: str
    command_min: float
    command_max: float
    slew_per_s: float
    heat: RunHeat
    begins_rms_a: float | None
    heating_rms_a: float | None
    budget_used_s: float | None
    recording_mb: float
    highest_rate_hz: float
    rate_note: str
    line: StraightLine | None

    def to_mapping(self) -> dict[str, Any]:
        """Return the fields as plain values."""
        mapping = asdict(self)
        del mapping["heat"]  # a part of a campaign's sums, of no meaning by itself
        del mapping["line"]  # of no meaning before somebody asks for it
        return mapping


def forecast_of(
    loaded: LoadedExperiment,
    reference: Reference,
    begun: Begun,
    conditioned: F64,
    heat_a2: float = 0.0,
) -> Forecast:
    """Run the compensator on its input, and note what comes of it.

    Args:
        loaded: The experiment.
        reference: Every sample of its waveform.
        begun: The compensator's input, and its memory at the start.
        conditioned: float64[m], commands that come before the waveform's.
        heat_a2: Running mean square of the coil current before all of them, in A^2.

    Raises:
        ModelError: The model has no inverse.
    """
    config = loaded.config
    compensator = Compensator(loaded.model, config.sample_rate_hz)
    if begun.state is not None:
        compensator.restore(begun.state)
    input_um = begun.input_um
    heat_a2 = max(heat_a2, config.safe.value**2)
    limits, rate_hz = config.limits, config.sample_rate_hz
    figures = CommandFigures(config, config.safe.value, heat_a2)
    heat = RunHeat()
    if conditioned.size:
        figures.add(conditioned)
        heat = heat.then(conditioned, limits, rate_hz)
    values = reference.values
    ends = LineEnds()
    wanted = np.empty(min(_CHUNK, input_um.size))
    for start in range(0, input_um.size, _CHUNK):
        part = input_um[start : start + _CHUNK]
        out = wanted[: part.size]
        compensator.process(part, out)
        figures.add(out)
        ends.add(values[start : start + _CHUNK], out)
        heat = heat.then(out, limits, rate_hz)
    byte_count = _BYTES_A_SAMPLE + (0.0 if input_um is reference.values else _BYTES_OF_INPUT)
    return Forecast(
        samples=values.size,
        duration_s=values.size / config.sample_rate_hz,
        before_s=conditioned.size / config.sample_rate_hz,
        begins=begun.begins,
        reference_min=float(values.min()),
        reference_max=float(values.max()),
        command_unit=loaded.device.info.command_unit,
        command_min=figures.low,
        command_max=figures.high,
        slew_per_s=figures.slew_per_s,
        heat=heat,
        begins_rms_a=None if figures.heat.rms_a is None else math.sqrt(heat_a2),
        heating_rms_a=figures.heat.rms_a,
        budget_used_s=figures.heat.used_s,
        recording_mb=(values.size + conditioned.size) * byte_count / 1e6,
        highest_rate_hz=loaded.device.info.max_rate_hz,
        rate_note=loaded.device.info.rate_note,
        line=None if loaded.model is None else ends.line(),
    )


class CommandFigures:
    """What limits are held against, gathered from commands that follow one another.

    Args:
        config: The experiment.
        last: Command before the first of them; None where there is none to step from.
        heat_a2: Running mean square of the coil current before them, in A^2.

    Attributes:
        low: Lowest command.
        high: Highest command.
        last: Command before the next ones; None where they are not to be held against one.
        heat: The thermal budget.
    """

    def __init__(self, config: Experiment, last: float | None, heat_a2: float) -> None:
        self.last = last
        self.low = math.inf if last is None else last
        self.high = -math.inf if last is None else last
        self.heat = CoilHeat(config.limits, config.sample_rate_hz, heat_a2)
        self._rate_hz = config.sample_rate_hz
        self._step = 0.0

    def add(self, command: F64) -> None:
        """Go on with the next commands: float64[n], n > 0."""
        before = command[0] if self.last is None else self.last
        with np.errstate(over="ignore", invalid="ignore"):  # what comes of it is refused
            steps = np.abs(np.diff(command, prepend=before))
        self.low = float(np.minimum(self.low, command.min()))  # keeps a NaN, where min() would not
        self.high = float(np.maximum(self.high, command.max()))
        self._step = float(np.maximum(self._step, steps.max()))
        self.last = float(command[-1])
        self.heat.add(command)

    @property
    def slew_per_s(self) -> float:
        """Fastest change."""
        return self._step * self._rate_hz
