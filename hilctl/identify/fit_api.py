"""Types of a fit: its prepared data, what it is asked for, and what it returns."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, TypeAlias

import numpy as np

from hilctl.base.errors import DataError
from hilctl.base.types import F64, CommandUnit
from hilctl.identify.data.records import History, Record, Records, SteadyLoop
from hilctl.identify.parallel import MapFunction, serial_map
from hilctl.identify.settings import FitSettings
from hilctl.identify.staged.fit_data import GAMMA_S, PARAMETERS, SPACING, plays_and_slopes
from hilctl.kernels.hysteresis import play_outputs, play_sum_shared, rest_memory
from hilctl.models.base import HysteresisModel
from hilctl.models.integrated import ButterflyModel, IntegratedModel
from hilctl.models.linear_stages import FirstMode, FurtherMode
from hilctl.models.plays import PlayModel

PERIODS = 3
"""Simulated periods of a loop; the last is evaluated, since differential models settle slowly."""

CREEP_S = 0.1  # time constant in the law of creep
BEYOND = 0.15  # of half the range: margin of commands that an inverse may output


@dataclass(frozen=True, slots=True)
class _Run:
    """One record: command and |rate|, float64[n]; its evaluated samples; their place among all."""

    command: F64
    speed: F64
    judged: slice
    place: slice
    loop: bool


class FitData:
    """Commands, rates and evaluated displacements of all records.

    Attributes:
        target_um: float64[N], measured displacement of all evaluated samples.
        places: For each record, its part of the N samples.
        reach: Half the largest peak-to-peak command; plays with a larger threshold do not move in a
            steady cycle.
        speed: Largest |rate| of the command, in command units per second.
        stroke_um: Largest peak-to-peak displacement of a record.
        output_range_um: Lowest and highest evaluated displacement.
    """

    def __init__(self, records: Records, unit: CommandUnit = "A") -> None:
        if not records:
            raise DataError("no records to fit: the list of loops and histories is empty")
        self.records = tuple(records)
        self.unit = unit
        self._runs: list[_Run] = []
        targets: list[F64] = []
        end = 0
        for record in self.records:
            command, rate, ignored = record.run()
            targets.append(record.displacement_um[ignored - command.size :])
            judged = slice(ignored, command.size)
            place = slice(end, end + command.size - ignored)
            end = place.stop
            loop = isinstance(record, SteadyLoop)
            self._runs.append(_Run(command, np.abs(rate), judged, place, loop))
        self.target_um = np.concatenate(targets)
        self.places = tuple(run.place for run in self._runs)
        self.reach = max(0.5 * float(np.ptp(run.command)) for run in self._runs)
        self.speed = max(float(run.speed.max()) for run in self._runs)
        self.stroke_um = max(float(np.ptp(target)) for target in targets)
        self.input_range = (
            min(float(run.command.min()) for run in self._runs),
            max(float(run.command.max()) for run in self._runs),
        )
        self.output_range_um = (float(self.target_um.min()), float(self.target_um.max()))

    @cached_property
    def creep(self) -> F64:
        """Columns of a constant per record and ln(1 + t / 0.1 s) per history, float64[N, f]."""
        columns: list[F64] = []
        for record, place in zip(self.records, self.places, strict=True):
            part = np.ones((place.stop - place.start, 1))
            if isinstance(record, History):
                time_s = record.time_s[record.ignore :]
                part = np.column_stack([part, np.log1p(time_s / CREEP_S)])
            column = np.zeros((self.target_um.size, part.shape[1]))
            column[place] = part
            columns.append(column)
        return np.hstack(columns)

    def with_creep(self, responses_um: F64) -> F64:
        """Return responses with the offset and creep of each record that fit best: float64[N]."""
        own = np.linalg.lstsq(self.creep, self.target_um - responses_um, rcond=None)[0]
        return responses_um + self.creep @ own

    @property
    def loops(self) -> tuple[SteadyLoop, ...]:
        """The records that are steady loops."""
        return tuple(record for record in self.records if isinstance(record, SteadyLoop))

    @property
    def speeds(self) -> list[F64]:
        """|rate| of each loop's evaluated samples and of each whole history, per second."""
        return [run.speed[run.judged] if run.loop else run.speed for run in self._runs]

    @property
    def gain(self) -> float:
        """Largest stroke over largest peak-to-peak command, in um per command unit."""
        return self.stroke_um / (2.0 * self.reach)

    @property
    def command_span(self) -> tuple[float, float]:
        """The range of the command plus 15 %, for inverses that need a bounded range."""
        low, high = self.input_range
        more = BEYOND * 0.5 * (high - low)
        return low - more, high + more

    def play_sum(self, direct: float, thresholds: F64, weights: F64, growth_s: float) -> F64:
        """Return ``direct v + sum weights_i F_i[v]`` of all evaluated samples: float64[N]."""
        out = np.empty(self.target_um.size)
        for run in self._runs:
            response = np.empty(run.command.size)
            memory = rest_memory(thresholds.size)
            play_sum_shared(
                run.command, growth_s * run.speed, direct, thresholds, weights, memory, response
            )
            out[run.place] = response[run.judged]
        return out

    def columns(self, thresholds: F64, growth_s: float = 0.0) -> F64:
        """Return command and output of each play for all evaluated samples: float64[N, n + 1]."""
        out = np.empty((self.target_um.size, thresholds.size + 1))
        for run in self._runs:
            response = np.empty((run.command.size, thresholds.size))
            memory = rest_memory(thresholds.size)
            play_outputs(run.command, growth_s * run.speed, thresholds, memory, response)
            out[run.place, 0] = run.command[run.judged]
            out[run.place, 1:] = response[run.judged]
        return out

    def plays(
        self, spacing: float, growth_s: float, numbers: F64, weights: F64
    ) -> tuple[F64, F64, F64]:
        """Run plays of thresholds ``spacing numbers_i``, with derivatives.

        Return the command float64[N], each play's output float64[N, n], and the derivatives of
        their weighted sum by spacing and growth, float64[N, 2].
        """
        size = self.target_um.size
        command, outputs = np.empty(size), np.empty((size, numbers.size))
        slopes = np.empty((size, 2))
        for run in self._runs:
            v = run.command
            out, by = np.empty((v.size, numbers.size)), np.empty((v.size, PARAMETERS))
            none = np.zeros((v.size, PARAMETERS))  # the command itself depends on nothing
            plays_and_slopes(v, none, run.speed, spacing, growth_s, numbers, weights, 1, out, by)
            command[run.place], outputs[run.place] = v[run.judged], out[run.judged]
            slopes[run.place] = by[run.judged][:, [SPACING, GAMMA_S]]
        return command, outputs, slopes

    def response_um(self, model: PlayModel) -> F64:
        """Return a model's displacement of all evaluated samples: float64[N]."""
        x = self.play_sum(
            model.direct,
            np.array(model.thresholds),
            np.array(model.weights),
            model.threshold_growth_s,
        )
        if isinstance(model, IntegratedModel):
            x = model.deadband(x)
        elif isinstance(model, ButterflyModel):
            x = model.shape(np.abs(x + model.bias))
        return x + model.output_offset_um

    def stack(self, run: Callable[[F64], F64]) -> F64:
        """Stack a rate-independent function of each command, float64[N] or float64[N, m]."""
        parts = []
        for record, place in zip(self.records, self.places, strict=True):
            periods = PERIODS if isinstance(record, SteadyLoop) else 1
            parts.append(run(np.tile(record.command, periods))[place.start - place.stop :])
        return np.concatenate(parts)

    def common(self, offset_um: float) -> dict[str, Any]:
        """Return the fields that every model has, by name."""
        return {
            "input_unit": self.unit,
            "input_range": self.input_range,
            "output_range_um": self.output_range_um,
            "output_offset_um": offset_um,
        }


LEAST_SLOPE = 0.01  # smallest slope that a model may have, of the mean slope of the data

OnProgress: TypeAlias = Callable[[float, str], None]
"""Progress callback: completed part (0 to 1) and current step."""


def ignore_progress(done: float, text: str) -> None:
    """Ignore a progress report."""


Structure: TypeAlias = FirstMode | bool
"""First mode of the structure: measured, to be identified (True), or none (False)."""


@dataclass(frozen=True, slots=True)
class FitRequest:
    """Records to fit, and settings."""

    records: Sequence[Record]
    settings: FitSettings
    unit: CommandUnit = "A"
    source: Sequence[str] = ()  # names of recordings or files, for the provenance
    run: MapFunction = serial_map
    progress: OnProgress = ignore_progress
    start: object | None = None  # start of the search, see :class:`FitJob`
    structure: FirstMode | None = None  # measured first mode, near which histories are fitted
    modes: Sequence[FurtherMode] = ()  # known further modes, for kinds that have them
    validate: Sequence[Record] = ()  # held out if no part of the others can be


@dataclass(frozen=True, slots=True)
class FitJob:
    """Prepared data and settings of a fit that continues from ``start``, another fit's end."""

    data: FitData
    settings: FitSettings
    run: MapFunction = serial_map
    progress: OnProgress = ignore_progress
    start: object | None = None
    structure: Structure = True

    @property
    def least(self) -> float:
        """Smallest slope that a model may have, in um per command unit."""
        return LEAST_SLOPE * self.data.gain


@dataclass(frozen=True, slots=True)
class StartOutcome:
    """One start of a search."""

    start: str  # ``data``, ``random N``, or ``weights N`` for a linear solution
    first_rms_percent: float  # weighted error at the start, in percent of the largest peak-to-peak
    rms_percent: float
    evaluations: int  # evaluations of the criterion, without those for derivatives


@dataclass(frozen=True)
class FoundModel:
    """A model without provenance, and how it was identified."""

    model: HysteresisModel
    numbers: int
    # by published name, in command units, um and s; empty for tables
    parameters: dict[str, float] = field(default_factory=dict)
    starts: tuple[StartOutcome, ...] = ()
    standard_errors: dict[str, float] = field(default_factory=dict)  # of the parameters, if known
    at_bound: tuple[str, ...] = ()
    end: object | None = None  # end of the search, from which another fit can start
