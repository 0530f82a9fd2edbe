"""Long histories with fewer samples: a search goes through its data hundreds of times."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from hilctl.base.types import F64, I64
from hilctl.identify.data.records import History, Record
from hilctl.kernels.hysteresis import play_outputs, rest_memory

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
