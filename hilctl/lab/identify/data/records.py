"""Records that models are fitted to: steady loops and time histories."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import TypeAlias

import numpy as np
from scipy.interpolate import CubicSpline

from hilctl.base.errors import DataError
from hilctl.base.types import F64, I64, Mask
from hilctl.kernels.hysteresis import play_outputs, rest_memory

FEWEST_POINTS = 16
SETTLING = 3  # times the length of a gap: the motion after it that is not evaluated


@dataclass(frozen=True, slots=True)
class SteadyLoop:
    """One steady cycle, averaged over several and resampled evenly in time.

    Published numbers of points are 200 (chapter 4), 400 (5.14) and 300 (6.24).
    """

    label: str  # name of the record, such as ``sine 6 A 10 Hz``
    command: F64  # float64[M], command in the device's unit
    displacement_um: F64  # float64[M]
    frequency_hz: float
    sample_rate_hz: float = 0.0  # sample rate of the run that it was averaged from; 0.0 if unknown
    start_s: float = 0.0  # time of the first averaged cycle in the run
    drift_um_per_s: float = 0.0  # from the first half of the cycles to the second one

    def __post_init__(self) -> None:
        check_signals(self.label, self.command, self.displacement_um)
        if not self.frequency_hz > 0.0:
            raise DataError(f"{self.label}: frequency_hz must be > 0: {self.frequency_hz!r}")

    def rate(self) -> F64:
        """Return the rate of the command at each point, float64[M], as in a run.

        A model uses the backward difference over one sample of a run. So the difference is taken
        over one sample of the run on a periodic spline, not over points of the loop, which would be
        late by half a point. If the sample rate is unknown, it is the derivative of the spline.

        A run with fewer samples per cycle than points turns its command at other phases: the error
        is 0.2 % of the stroke for 200 samples, and below 0.02 % for 333 and more.
        """
        points = self.command.size
        time = np.arange(points + 1) / (points * self.frequency_hz)
        spline = CubicSpline(time, np.append(self.command, self.command[0]), bc_type="periodic")
        if self.sample_rate_hz <= 0.0:
            return np.asarray(spline(time[:-1], 1), dtype=np.float64)
        before = spline(time[:-1] - 1.0 / self.sample_rate_hz)
        return np.asarray((self.command - before) * self.sample_rate_hz, dtype=np.float64)


@dataclass(frozen=True, slots=True)
class History:
    """Time history that is evaluated sample by sample, for data that does not repeat.

    The hysteresis starts at the first sample, which must be the start of the motion or far enough
    before the first evaluated sample.
    """

    label: str
    command: F64  # float64[n], command in the device's unit
    displacement_um: F64  # float64[n]
    sample_rate_hz: float
    ignore: int = 0  # samples at the start that are not evaluated
    held: I64 = field(default_factory=lambda: np.empty(0, np.int64))
    """Samples without a displacement; in those of skipped ticks the command was held."""
    rows: I64 = field(default_factory=lambda: np.empty(0, np.int64))
    """Row of each displacement in its table, from 1; empty if it is not from a table."""

    def __post_init__(self) -> None:
        check_signals(self.label, self.command, self.displacement_um)
        if not self.sample_rate_hz > 0.0:
            raise DataError(f"{self.label}: sample_rate_hz must be > 0: {self.sample_rate_hz!r}")
        if not 0 <= self.ignore <= self.command.size - FEWEST_POINTS:
            raise DataError(
                f"{self.label}: ignore must leave at least {FEWEST_POINTS} of "
                f"{self.command.size} samples: {self.ignore}"
            )

    @property
    def time_s(self) -> F64:
        """Time of each sample since the first: float64[n]."""
        return np.asarray(np.arange(self.command.size) / self.sample_rate_hz, dtype=np.float64)

    def without_lag(self, lag_samples: int) -> "History":
        """Return the history with a lag of the displacement, < 0 if it leads, taken out."""
        lead = max(-lag_samples, 0)
        end = max(self.command.size - abs(lag_samples), 0)
        shown = slice(max(lag_samples, 0), max(lag_samples, 0) + end)
        return replace(
            self,
            command=np.ascontiguousarray(self.command[lead : lead + end]),
            displacement_um=np.ascontiguousarray(self.displacement_um[shown]),
            rows=self.rows[shown],
        )

    def run(self) -> tuple[F64, F64, int]:
        """Return samples to simulate, their backward difference, and the number not evaluated."""
        rate = np.diff(self.command, prepend=self.command[0]) * self.sample_rate_hz
        return np.ascontiguousarray(self.command), rate, self.ignore

    def evaluated(self) -> Mask:
        """Return whether each sample is evaluated: bool[n].

        Samples from ``ignore`` on are, except skipped ticks and the motion after them: the command
        jumps to where it would have been, which excites dynamics that smooth motion does not show.
        """
        left_out = np.zeros(self.command.size, dtype=np.bool_)
        left_out[: self.ignore] = True
        for gap in np.split(self.held, np.flatnonzero(np.diff(self.held) > 1) + 1):
            if gap.size:
                left_out[gap[0] : gap[0] + (1 + SETTLING) * gap.size] = True
        return ~left_out

    def rate(self) -> F64:
        """Return the rate of the motion, float64[n]; skipped ticks do not make it faster."""
        kept = np.setdiff1d(np.arange(self.command.size), self.held, assume_unique=True)
        moved = np.interp(np.arange(self.command.size), kept, self.command[kept])
        return np.diff(moved, prepend=moved[0]) * self.sample_rate_hz


Record: TypeAlias = SteadyLoop | History
Records: TypeAlias = Sequence[SteadyLoop | History]


def check_signals(label: str, command: F64, displacement_um: F64) -> None:
    """Raise DataError if signals differ in length, are short, constant or not finite."""
    if command.ndim != 1 or command.shape != displacement_um.shape:
        raise DataError(
            f"{label}: command and displacement_um must have the same length: "
            f"{command.shape} and {displacement_um.shape}"
        )
    if command.size < FEWEST_POINTS:
        raise DataError(f"{label}: needs at least {FEWEST_POINTS} samples, has {command.size}")
    for name, values in (("command", command), ("displacement_um", displacement_um)):
        bad = np.flatnonzero(~np.isfinite(values))
        if bad.size:
            raise DataError(
                f"{label}: {name} must be finite: {float(values[bad[0]])!r} at sample {bad[0]}"
                f" ({bad.size} in all)"
            )
        if np.ptp(values) == 0.0:
            value = float(values[0])
            raise DataError(f"{label}: {name} is constant ({value!r})")


MOST_SAMPLES = 12_000
SMALLEST_TURN = 1e-3  # of the command's range: less is noise
SEED = 1


@dataclass(frozen=True, slots=True, kw_only=True)
class ThinHistory(History):
    """Some samples of a history, with their numbers in the whole and rates computed from it."""

    index: I64
    rates: F64

    @property
    def time_s(self) -> F64:
        """Time of each sample since the first of the whole: float64[n]."""
        return np.asarray(self.index / self.sample_rate_hz, dtype=np.float64)

    def rate(self) -> F64:
        """Return the rate of the motion, see :meth:`History.rate`."""
        return self.rates

    def run(self) -> tuple[F64, F64, int]:
        """Return the samples to simulate, see :meth:`History.run`."""
        return self.command, self.rates, self.ignore


def thinned(records: Sequence[Record], most: int = MOST_SAMPLES) -> tuple[Record, ...]:
    """Return records, of each longer history about ``most`` samples and its turning points.

    Samples that are not evaluated because of skipped ticks are omitted. Turning points determine
    the memory of a model without dynamics. The other samples are random, one per interval: evenly
    spaced ones might meet a few phases of a periodic command only.
    """
    return tuple(
        _thin(record, most)
        if isinstance(record, History) and (record.command.size > most or record.held.size)
        else record
        for record in records
    )


def turning_points(command: F64) -> I64:
    """Return where a command turns by more than :data:`SMALLEST_TURN`."""
    # A play of that width follows the command up to each turn.
    threshold = np.array([0.5 * SMALLEST_TURN * np.ptp(command)])
    followed = np.empty((command.size, 1))
    command = np.ascontiguousarray(command)
    play_outputs(command, np.zeros(command.size), threshold, rest_memory(1), followed)
    steps = np.diff(followed[:, 0])
    moves = np.flatnonzero(steps)
    turned = np.sign(steps[moves[:-1]]) != np.sign(steps[moves[1:]])
    return np.asarray(moves[:-1][turned] + 1)


AT_END = 0.05  # of the range of a command: it is at an end of it


def from_known_state(history: History) -> History:
    """Return a history that is not evaluated until its own motion determines its state.

    The state of a real actuator is unknown, also at a command of 0, until the first motion over the
    whole range. If that motion is not in the first half, the record is used from its first turn.
    """
    command = history.command
    span = float(np.ptp(command))
    if history.ignore:
        return history
    ends = command <= command.min() + AT_END * span, command >= command.max() - AT_END * span
    erased = max(int(end.argmax()) for end in ends)
    if erased > command.size // 2:
        erased = int(next(iter(turning_points(command)), 0))
    return replace(history, ignore=erased) if erased <= command.size // 2 else history


def _thin(record: History, most: int) -> ThinHistory:
    command, rates, ignore = record.run()
    edges = np.linspace(0, command.size, min(most, command.size) + 1).astype(np.int64)
    spread = np.random.default_rng(SEED).integers(edges[:-1], edges[1:])
    spread = spread[record.evaluated()[spread] | (spread < ignore)]
    index = np.unique(np.concatenate(([0], spread, turning_points(command))))
    return ThinHistory(
        label=record.label,
        command=np.ascontiguousarray(command[index]),
        displacement_um=np.ascontiguousarray(record.displacement_um[index]),
        sample_rate_hz=record.sample_rate_hz,
        ignore=int(np.searchsorted(index, ignore)),
        index=index,
        rates=np.ascontiguousarray(rates[index]),
    )
