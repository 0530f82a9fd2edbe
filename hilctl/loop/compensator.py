"""The compensator: from a reference block to requested commands; owns the hysteresis state."""

import math

import numpy as np

from hilctl.base.errors import ModelError
from hilctl.base.segments import Segment
from hilctl.base.types import F64
from hilctl.models.base import HysteresisModel, Operator


class Compensator:
    """Inverse of a model for loop and replay; without a model it passes the input through."""

    def __init__(self, model: HysteresisModel | None, sample_rate_hz: float) -> None:
        self._operator: Operator | None = model.inverse(sample_rate_hz) if model else None
        self.preview = self._operator.preview if self._operator else 0
        """Samples by which the input leads the commands."""

    def ahead(self, reference: F64, last: Segment | None = None) -> F64:
        """Return a reference, float64[n], shifted by ``preview``; its last value repeats.

        A periodic ``last`` waveform without a soft end continues instead.
        """
        if not self.preview:
            return reference
        after = np.repeat(reference[-1:], min(self.preview, reference.size))
        # The period of a file is not verified.
        if last and last.period and last.steady_stop == last.stop and last.kind != "file":
            back = last.period * math.ceil(self.preview / last.period)
            if back <= min(reference.size, last.stop - last.steady_start):
                tail = reference[reference.size - math.ceil(back) :]
                place = tail.size - back + np.arange(self.preview)
                after = np.interp(place, np.arange(tail.size), tail)
        return np.concatenate((reference[self.preview :], after))

    def begin(self, reference: F64) -> None:
        """Process the first ``preview`` samples, which precede the first command."""
        if self.preview:
            first = reference[: self.preview].copy()
            self.process(first, np.empty_like(first))

    def process(self, input_um: F64, wanted: F64) -> None:
        """Fill ``wanted`` (float64[n], command unit) from ``input_um`` (float64[n])."""
        if self._operator is None:
            wanted[:] = input_um
        else:
            self._operator.process(input_um, wanted)

    def warm_up(self) -> None:
        """Compile or load all kernels; the state stays as it is."""
        state = self.state()
        self.process(np.zeros(2), np.zeros(2))
        self.restore(state)

    def state(self, out: F64 | None = None) -> F64:
        """Return a copy of the hysteresis state: float64[state_size], written to ``out`` if set."""
        if self._operator is None:
            return np.empty(0) if out is None else out
        return self._operator.state(out)

    def restore(self, state: F64) -> None:
        """Restore a result of :meth:`state`; raise ModelError if it belongs to another model."""
        if self._operator is not None:
            self._operator.restore(state)
        elif state.size:
            raise ModelError(f"no compensator, but a state of {state.size} values")

    @property
    def state_size(self) -> int:
        """Size of the hysteresis state."""
        return self.state().size
