"""What models are fitted to: steady loops and whole time histories."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from scipy.interpolate import CubicSpline

from hilctl.base.errors import DataError
from hilctl.base.types import F64, I64
from hilctl.kernels.hysteresis import play_outputs, rest_memory

FEWEST_POINTS = 16


@dataclass(frozen=True, slots=True)
class SteadyLoop:
    """One steady cycle, averaged over several and resampled evenly in time.

    Published numbers of points are 200 (chapter 4), 400 (5.14) and 300 (6.24).

    Attributes:
        label: What ran, for people: ``sine 6 A 10 Hz``.
        command: float64[M], command in the device's unit.
        displacement_um: float64[M].
        frequency_hz: Cycles a second.
        sample_rate_hz: Rate of the run that it was averaged from; 0.0 where that is not known.
    """

    label: str
    command: F64
    displacement_um: F64
    frequency_hz: float
    sample_rate_hz: float = 0.0

    def __post_init__(self) -> None:
        check_signals(self.label, self.command, self.displacement_um)
        if not self.frequency_hz > 0.0:
            raise DataError(f"{self.label}: frequency_hz must be > 0: {self.frequency_hz!r}")

    def rate(self) -> F64:
        """Return the command's rate at each point as a run at ``sample_rate_hz`` sees it.

        A model takes its rate from the last two samples of a run, so at 50 kHz its rate is
        10 us late. A backward difference of this loop's own points would be late by half a point
        instead: 167 us for 300 points at 10 Hz. So the difference is taken over one sample of the
        run, between points of a periodic spline; where the run's rate is not known, it is the
        spline's derivative, which is not late at all.

        What is left is that a run with fewer samples a cycle than there are points turns its
        command at other phases: 0.2 % of the stroke for 200 samples (250 Hz at 50 kHz), less than
        0.02 % for 333 and more.

        Returns:
            float64[M], command units a second.
        """
        points = self.command.size
        time = np.arange(points + 1) / (points * self.frequency_hz)
        spline = CubicSpline(time, np.append(self.command, self.command[0]), bc_type="periodic")
        if self.sample_rate_hz <= 0.0:
            return np.asarray(spline(time[:-1], 1), dtype=np.float64)
        before = spline(time[:-1] - 1.0 / self.sample_rate_hz)
        return np.asarray((self.command - before) * self.sample_rate_hz, dtype=np.float64)

    def run(self) -> tuple[F64, F64, int]:
        """Return what a model is run on: two periods, of which the second is judged.

        One period from rest brings every play operator to its periodic state: an operator clips
        its state to a range, so a period as a whole does, and doing it again changes nothing.

        Returns:
            Command float64[2 M], its rate float64[2 M], number of samples that are not judged.
        """
        return np.tile(self.command, 2), np.tile(self.rate(), 2), self.command.size


@dataclass(frozen=True, slots=True)
class History:
    """A whole time history judged sample by sample, for data that does not repeat.

    The hysteresis starts from the first sample, so the start of the data must be the start of the
    motion or lie far enough before the first judged sample.

    Attributes:
        label: What ran, for people.
        command: float64[n], command in the device's unit.
        displacement_um: float64[n].
        sample_rate_hz: Samples a second.
        ignore: Samples at the start that are not judged.
    """

    label: str
    command: F64
    displacement_um: F64
    sample_rate_hz: float
    ignore: int = 0

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
        """Return the history with the displacement taken ``lag_samples`` later.

        Some sensors and recorders deliver a displacement late. What is taken out here is not in
        the model any more, and a compensator made from it does not undo it.

        Args:
            lag_samples: Whole samples by which the displacement lags the command, >= 0.

        Raises:
            DataError: It is negative or leaves too few samples.
        """
        if lag_samples < 0:
            raise DataError(f"{self.label}: lag_samples must be >= 0: {lag_samples}")
        end = self.command.size - lag_samples
        return History(
            self.label,
            np.ascontiguousarray(self.command[: max(end, 0)]),
            np.ascontiguousarray(self.displacement_um[lag_samples:]),
            self.sample_rate_hz,
            self.ignore,
        )

    def run(self) -> tuple[F64, F64, int]:
        """Return what a model is run on.

        Returns:
            Command float64[n], its rate float64[n] (backward difference, as models take it; 0 at
            the first sample), number of samples that are not judged.
        """
        rate = np.diff(self.command, prepend=self.command[0]) * self.sample_rate_hz
        return np.ascontiguousarray(self.command), rate, self.ignore


Record: TypeAlias = SteadyLoop | History
Records: TypeAlias = Sequence[SteadyLoop | History]


def check_signals(label: str, command: F64, displacement_um: F64) -> None:
    """Check that two signals belong together and can be judged.

    Raises:
        DataError: They differ in length, are too short, hold a value that is not finite, or the
            command or the displacement never changes.
    """
    if command.ndim != 1 or command.shape != displacement_um.shape:
        raise DataError(
            f"{label}: command and displacement_um must be equally long: "
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
            raise DataError(f"{label}: {name} never changes, it is {value!r} throughout")


MOST_SAMPLES = 12_000
SMALLEST_TURN = 1e-3  # of the command's range: less is noise
SEED = 1


@dataclass(frozen=True, slots=True, kw_only=True)
class ThinHistory(History):
    """Some samples of a history.

    Attributes:
        index: int64[n], their numbers in the whole.
        rates: float64[n], rate of the command at each, as the whole has it.
    """

    index: I64
    rates: F64

    @property
    def time_s(self) -> F64:
        """Time of each sample since the first of the whole: float64[n]."""
        return np.asarray(self.index / self.sample_rate_hz, dtype=np.float64)

    def run(self) -> tuple[F64, F64, int]:
        """Return what a model is run on, see :meth:`History.run`."""
        return self.command, self.rates, self.ignore


def thinned(records: Sequence[Record], most: int = MOST_SAMPLES) -> tuple[Record, ...]:
    """Return records, of each longer history about ``most`` samples and its turning points.

    What has memory is in its turning points, so a model that has no other dynamics ends where the
    whole history would take it. The others are spread at random, one of each of many stretches:
    evenly spaced ones might meet a command that repeats at a few phases only.
    """
    return tuple(
        _thin(record, most)
        if isinstance(record, History) and record.command.size > most
        else record
        for record in records
    )


def turning_points(command: F64) -> I64:
    """Return where a command turns, but for what is smaller than :data:`SMALLEST_TURN`.

    A play of that width follows the command up to each turn and rests from there to the next.
    """
    threshold = np.array([0.5 * SMALLEST_TURN * np.ptp(command)])
    followed = np.empty((command.size, 1))
    command = np.ascontiguousarray(command)
    play_outputs(command, np.zeros(command.size), threshold, rest_memory(1), followed)
    steps = np.diff(followed[:, 0])
    moves = np.flatnonzero(steps)
    turned = np.sign(steps[moves[:-1]]) != np.sign(steps[moves[1:]])
    return np.asarray(moves[:-1][turned] + 1)


def _thin(record: History, most: int) -> ThinHistory:
    command, rates, ignore = record.run()
    edges = np.linspace(0, command.size, most + 1).astype(np.int64)
    spread = np.random.default_rng(SEED).integers(edges[:-1], edges[1:])
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
