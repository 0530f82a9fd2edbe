"""Data made ready for the kernels: one call gives a model's response to all of it."""

from dataclasses import dataclass

import numpy as np

from hilctl.base.arrays import F64
from hilctl.base.errors import DataError
from hilctl.identify.data import History, Loop, Records
from hilctl.kernels.hysteresis import play_outputs, play_sum_shared, rest_memory
from hilctl.models.integrated import IntegratedModel
from hilctl.models.plays import PlayModel

CREEP_S = 0.1  # time that creep is counted from


@dataclass(frozen=True, slots=True)
class _Run:
    """One record: command and |rate|, float64[n]; the judged samples; their place among all."""

    command: F64
    speed: F64
    judged: slice
    place: slice
    loop: bool


class Bench:
    """All records' commands, rates and judged displacements.

    Attributes:
        target_um: float64[N], measured displacement of all judged samples, record after record.
        places: For each record, its part of the N samples.
        reach: Half the largest peak-to-peak command: no play with a larger threshold ever moves
            in a steady cycle.
        speed: Largest |rate| of the command, in command units a second.
        stroke_um: Largest peak-to-peak displacement of a record.
        input_range: Lowest and highest command.
        output_range_um: Lowest and highest judged displacement.
        creep: float64[N, f], what each record may have of its own beside a model: a constant, and
            for a whole history ln(1 + t / 0.1 s) as well, the usual law of creep.
    """

    def __init__(self, data: Records) -> None:
        """Prepare records.

        Raises:
            DataError: There are none.
        """
        if not data:
            raise DataError("nothing to identify a model from: the list of loops is empty")
        self._runs: list[_Run] = []
        targets: list[F64] = []
        end = 0
        for record in data:
            command, rate, ignored = record.run()
            targets.append(record.displacement_um[ignored - command.size :])
            judged = slice(ignored, command.size)
            place = slice(end, end + command.size - ignored)
            end = place.stop
            self._runs.append(_Run(command, np.abs(rate), judged, place, isinstance(record, Loop)))
        self.target_um = np.concatenate(targets)
        self.places = tuple(run.place for run in self._runs)
        self.reach = max(0.5 * float(np.ptp(run.command)) for run in self._runs)
        self.speed = max(float(run.speed.max()) for run in self._runs)
        self.stroke_um = max(float(np.ptp(target)) for target in targets)
        self.input_range = (
            min(float(run.command.min()) for run in self._runs),
            max(float(run.command.max()) for run in self._runs),
        )
        self.creep = self._creep(data)
        self.output_range_um = (float(self.target_um.min()), float(self.target_um.max()))

    def _creep(self, data: Records) -> F64:
        columns: list[F64] = []
        for record, place in zip(data, self.places, strict=True):
            part = np.ones((place.stop - place.start, 1))
            if isinstance(record, History):
                time_s = np.arange(record.command.size)[record.ignore :] / record.sample_rate_hz
                part = np.column_stack([part, np.log1p(time_s / CREEP_S)])
            column = np.zeros((self.target_um.size, part.shape[1]))
            column[place] = part
            columns.append(column)
        return np.hstack(columns)

    @property
    def speeds(self) -> list[F64]:
        """|rate| of each record's judged samples, command units a second; whole of a history."""
        return [run.speed[run.judged] if run.loop else run.speed for run in self._runs]

    @property
    def gain(self) -> float:
        """Largest stroke over largest peak-to-peak command, in um per command unit."""
        return self.stroke_um / (2.0 * self.reach)

    def play_sum(self, direct: float, thresholds: F64, weights: F64, growth_s: float) -> F64:
        """Return ``direct v + sum weights_i F_i[v]`` of all judged samples: float64[N]."""
        out = np.empty(self.target_um.size)
        for run in self._runs:
            response = np.empty(run.command.size)
            memory = rest_memory(thresholds.size)
            play_sum_shared(
                run.command, growth_s * run.speed, direct, thresholds, weights, memory, response
            )
            out[run.place] = response[run.judged]
        return out

    def columns(self, thresholds: F64, growth_s: float) -> F64:
        """Return the command and each play's output of all judged samples: float64[N, n + 1]."""
        out = np.empty((self.target_um.size, thresholds.size + 1))
        for run in self._runs:
            response = np.empty((run.command.size, thresholds.size))
            memory = rest_memory(thresholds.size)
            play_outputs(run.command, growth_s * run.speed, thresholds, memory, response)
            out[run.place, 0] = run.command[run.judged]
            out[run.place, 1:] = response[run.judged]
        return out

    def response_um(self, model: PlayModel) -> F64:
        """Return a model's displacement of all judged samples: float64[N]."""
        x = self.play_sum(
            model.direct,
            np.array(model.thresholds),
            np.array(model.weights),
            model.threshold_growth_s,
        )
        if isinstance(model, IntegratedModel):
            x = model.deadband(x)
        return x + model.output_offset_um
