"""Operators one after another, as one operator with one memory; what shifts in time and smooths."""

import math
from collections.abc import Sequence

import numpy as np

from hilctl.base.types import F64
from hilctl.kernels.dynamics import between_stage, delay_block
from hilctl.models.base import Operator

_WIDEST = 64


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
        self._stages = tuple(stages)
        self.keep_in(self._memory)

    def keep_in(self, memory: F64) -> None:
        """Keep the memory in a given place from now on, that of each stage too."""
        super().keep_in(memory)
        start = 0
        for stage in self._stages:
            stop = start + stage.state().size
            stage.keep_in(memory[start:stop])
            start = stop

    def stand(self, seconds: float) -> None:
        """Let time pass with the input as it was last."""
        for stage in self._stages:
            stage.stand(seconds)

    def _run(self, block: F64, memory: F64, out: F64) -> None:
        for stage in self._stages:
            block = stage.process(block, out)


def delayed(samples: int) -> Operator:
    """Return an operator that holds a signal back by a number of samples, >= 1."""
    return Operator(delay_block, samples)


def between(part: float) -> Operator:
    """Return an operator that takes a signal ``part`` of the way from the sample before to each."""
    return Operator.staged(between_stage, np.array([part]), 0)


def smoothing_weights(
    width: float, slope_gain: float = 0.0, bend_gain: float = 0.0
) -> tuple[F64, int]:
    """Return weights for y + slope_gain y' + bend_gain y'' of a smoothed y, per sample.

    A cubic B-spline smooths, four boxes one after another, and minus half its variance times y''
    makes its response flat: 1 - (w s)^4 / 8 at an angular frequency w, for a standard deviation s.
    So slow signals pass as they are, and corners are rounded within about 2 s.

    Args:
        width: Standard deviation s in samples; 0 for plain central differences.
        slope_gain: In samples.
        bend_gain: In samples squared.

    Returns:
        float64[2m + 1], weights of the samples from the oldest to the newest, which add up to 1;
        and m, the samples by which the newest is ahead. Boxes are at most 64 samples long.
    """
    box = min(_WIDEST, round(math.sqrt(1.0 + 3.0 * width**2)))
    ones = np.full(box, 1.0 / box)
    pair = np.convolve(ones, ones)
    spline = np.convolve(pair, pair)
    variance = (box**2 - 1) / 3.0
    weights = np.pad(spline, 1)
    weights += slope_gain * np.convolve(spline, (-0.5, 0.0, 0.5))
    weights += (bend_gain - 0.5 * variance) * np.convolve(spline, (1.0, -2.0, 1.0))
    return weights, 2 * box - 1
