"""Signals of a run that live views show."""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from hilctl.base.samples import BlockBatch
from hilctl.base.types import F64, I64, U32


@dataclass(frozen=True, slots=True)
class Signal:
    """One signal: name for programs, label to display, and ``um`` or the unit of the commands."""

    name: str
    label: str
    unit: Literal["um", "command"]


SIGNALS = (
    Signal("reference", "reference", "um"),
    Signal("displacement", "displacement", "um"),
    Signal("error", "error", "um"),
    Signal("command", "command", "command"),
    Signal("measured", "measured command", "command"),
    Signal("wanted", "command before the limiter", "command"),
)
"""The signals; their order is that of the rows of every array of signals."""
ROW = {signal.name: row for row, signal in enumerate(SIGNALS)}


@dataclass(frozen=True, slots=True)
class Traces:
    """Signals of n samples in order.

    Attributes:
        index: int64[n], sample index since the start of the run; a jump is a gap.
        values: float64[len(SIGNALS), n]; NaN if there is no value.
        flags: uint32[n], bits of :class:`hilctl.base.samples.Flag`.
    """

    index: I64
    values: F64
    flags: U32

    def rows(self, chosen: slice) -> "Traces":
        """Return the selected samples."""
        return Traces(self.index[chosen], self.values[:, chosen], self.flags[chosen])

    def part(self, start: float, stop: float) -> "Traces":
        """Return the samples with an index in [start, stop)."""
        low, high = np.searchsorted(self.index, (start, stop))
        return self.rows(slice(int(low), int(high)))


def traces_of(batch: BlockBatch, waveform_unit: str) -> Traces:
    """Return the signals of blocks; without a reference in um there is no error."""
    samples = batch.samples()
    reference = samples.reference_um
    if waveform_unit != "um":
        reference = np.full_like(reference, np.nan)
    displacement_um, error_um = samples.displacement_um, samples.displacement_um - reference
    values = np.array(
        (reference, displacement_um, error_um, samples.command, samples.measured, samples.wanted)
    )
    values[~np.isfinite(values)] = np.nan
    return Traces(samples.index, values, samples.flags)
