"""Reference block in, wanted command block out; owns the hysteresis memory."""

import numpy as np

from hilctl.base.errors import ModelError
from hilctl.base.types import F64
from hilctl.models.base import HysteresisModel, Operator


class Compensator:
    """The inverse of a model, or nothing at all, as one thing that the loop and the replay run.

    Args:
        model: Model whose inverse turns um into commands; None passes the reference on.
        sample_rate_hz: Samples a second.
    """

    def __init__(self, model: HysteresisModel | None, sample_rate_hz: float) -> None:
        self._operator: Operator | None = model.inverse(sample_rate_hz) if model else None
        self.preview = self._operator.preview if self._operator else 0
        """Samples by which its input must run ahead of the commands."""

    def ahead(self, reference: F64) -> F64:
        """Return what to feed for a reference (float64[n]): itself, ``preview`` samples ahead.

        The last value stands for those that come after it.
        """
        if not self.preview:
            return reference
        after = np.repeat(reference[-1:], min(self.preview, reference.size))
        return np.concatenate((reference[self.preview :], after))

    def begin(self, reference: F64) -> None:
        """Run through what comes before the first command: ``preview`` samples of the reference.

        So the first command belongs to a reference that has stood at its first value until then.
        """
        if self.preview:
            first = reference[: self.preview].copy()
            self.process(first, np.empty_like(first))

    def process(self, input_um: F64, wanted: F64) -> None:
        """Fill ``wanted`` (float64[n], command unit) from ``input_um`` (float64[n]).

        Where there is no model, the input is in the command's unit.
        """
        if self._operator is None:
            wanted[:] = input_um
        else:
            self._operator.process(input_um, wanted)

    def warm_up(self) -> None:
        """Run once and forget it, so that nothing is compiled or loaded during a run."""
        state = self.state()
        self.process(np.zeros(2), np.zeros(2))
        self.restore(state)

    def state(self, out: F64 | None = None) -> F64:
        """Return a copy of the hysteresis memory: float64[state_size], in ``out`` if given."""
        if self._operator is None:
            return np.empty(0) if out is None else out
        return self._operator.state(out)

    def restore(self, state: F64) -> None:
        """Go back to a state that :meth:`state` returned.

        Raises:
            ModelError: The state is of another model.
        """
        if self._operator is not None:
            self._operator.restore(state)
        elif state.size:
            raise ModelError(f"no compensator, but a state of {state.size} values")

    @property
    def state_size(self) -> int:
        """Numbers in the hysteresis memory."""
        return self.state().size
