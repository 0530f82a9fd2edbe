"""Operators one after another, as one operator with one memory; and what shifts in time."""

from collections.abc import Sequence

import numpy as np

from hilctl.base.arrays import F64
from hilctl.kernels.dynamics import between_block, delay_block
from hilctl.models.base import Operator


class Chain(Operator):
    """Operators, each fed with what the one before it gives.

    Args:
        stages: The operators, first one first; their memories become parts of the chain's.
        preview: Samples by which the chain's input must run ahead of its output.
        input_offset: Added to the input first.
        output_offset: Added to the output last.
    """

    def __init__(
        self,
        stages: Sequence[Operator],
        *,
        preview: int = 0,
        input_offset: float = 0.0,
        output_offset: float = 0.0,
    ) -> None:
        rest = np.concatenate([stage.state() for stage in stages])
        super().__init__(
            self._run, rest.size - 1, input_offset=input_offset, output_offset=output_offset
        )
        self.preview = preview
        self._rest = rest
        self._memory[:] = rest
        self._stages = tuple(stages)
        start = 0
        for stage in stages:
            stop = start + stage.state().size
            stage.keep_in(self._memory[start:stop])
            start = stop

    def _run(self, block: F64, memory: F64, out: F64) -> None:
        for stage in self._stages:
            block = stage.process(block, out)


def delayed(samples: int) -> Operator:
    """Return an operator that holds a signal back by a number of samples, >= 1."""
    return Operator(delay_block, samples)


def between(part: float) -> Operator:
    """Return an operator that takes a signal ``part`` of the way from the sample before to each."""

    def run(x: F64, memory: F64, out: F64) -> None:
        between_block(x, part, memory, out)

    return Operator(run, 0)
