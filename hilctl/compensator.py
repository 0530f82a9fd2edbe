"""Reference block in, wanted command block out; owns the hysteresis memory."""

import numpy as np

from hilctl.arrays import F64
from hilctl.errors import ModelError
from hilctl.models.base import HysteresisModel, Operator


class Compensator:
    """The inverse of a model, or nothing at all, as one thing that the loop and the replay run.

    Args:
        model: Model whose inverse turns um into commands; None passes the reference on.
        sample_rate_hz: Samples a second.
    """

    def __init__(self, model: HysteresisModel | None, sample_rate_hz: float) -> None:
        self._operator: Operator | None = model.inverse(sample_rate_hz) if model else None

    def process(self, reference: F64, wanted: F64) -> None:
        """Fill ``wanted`` (float64[n], command unit) from ``reference`` (float64[n])."""
        if self._operator is None:
            wanted[:] = reference
        else:
            self._operator.process(reference, wanted)

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
