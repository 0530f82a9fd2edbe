"""All commands of a run, worked out from its first sample to its last; what repeats, once.

A long reference repeats, as a rule, and to compute all of it would take minutes. So cycles are
passed over when two in a row came out the same: so much the same that, were each of the others to
differ from the one before by as much, the last would still be the same.
"""

import math
from collections.abc import Callable
from typing import Protocol

import numpy as np

from hilctl.base.types import CHUNK, F64
from hilctl.loop.compensator import Compensator
from hilctl.waveforms.build import RepeatedPart
from hilctl.waveforms.shapes import LONG

_MOST_PERIODS = 1024
_LEAST_CYCLE = 65_536
"""Samples of which whole cycles are compared: less would be slow, one by one."""
_WHOLE = 1e-3
"""How far, of a sample, all that is passed over may be from whole samples."""
_SAME = 1e-3
"""How far the last cycle may be from the one that was worked out, as a part of its span."""


class CommandSink(Protocol):
    """What is gathered from commands as they come."""

    def add(self, reference: F64, command: F64) -> None:
        """Take the next ones: float64[n] each, n > 0."""
        ...

    def mark(self) -> None:
        """Note that a cycle begins."""
        ...

    def pass_over(self, samples: int, times: int) -> None:
        """Take the cycle since the mark, of so many samples, that many times more."""
        ...


class CommandSimulation:
    """Works the commands of a run out.

    Args:
        compensator: With the memory that the run begins with.
        input_um: Gives its input from a start to a stop, float64[stop - start]; asked for one part
            after the other.
        reference: Gives the reference in the same way.
        size: Samples of the run.
        figures: Takes what comes of it.
    """

    def __init__(
        self,
        compensator: Compensator,
        input_um: Callable[[int, int], F64],
        reference: Callable[[int, int], F64],
        size: int,
        figures: CommandSink,
    ) -> None:
        self._compensator, self._input_um, self._reference = compensator, input_um, reference
        self._size, self._figures = size, figures
        self._at = 0

    def go_through(self, repeats: tuple[RepeatedPart, ...]) -> None:
        """Work all of it out.

        Args:
            repeats: What repeats in its reference, in order.
        """
        for repeat in repeats:
            self._go_to(repeat.start)
            self._pass_over(repeat)
        self._go_to(self._size)

    def _go_to(self, stop: int, cycle: F64 | None = None) -> None:
        """Go on to a sample; fill ``cycle`` (float64[n]) with the commands on the way."""
        begins = self._at
        while self._at < stop:
            start = self._at
            self._at = min(start + CHUNK, stop)
            command = np.empty(self._at - start)
            self._compensator.process(self._input_um(start, self._at), command)
            self._figures.add(self._reference(start, self._at), command)
            if cycle is not None:
                cycle[start - begins : self._at - begins] = command

    def _pass_over(self, repeat: RepeatedPart) -> None:
        """Go on until a cycle came out like the one before it, and pass over those that follow."""
        # The input runs ahead of the reference: it is over with the repeats before that is.
        stop = repeat.stop - self._compensator.preview
        cycle = whole_cycle(repeat.period, stop - repeat.start)
        if cycle == 0:
            return
        before, now = np.full((2, cycle), math.nan)
        while stop - self._at >= 3 * cycle:
            self._figures.mark()
            self._go_to(self._at + cycle, now)
            times = (stop - self._at) // cycle - 1
            if _same(before, now, times):
                self._figures.pass_over(cycle, times)
                self._at += times * cycle
                return
            before, now = now, before


def _same(before: F64, now: F64, times: int) -> bool:
    with np.errstate(over="ignore", invalid="ignore"):  # what is not finite is never the same
        return bool(np.abs(now - before).max() * times <= _SAME * np.ptp(now))


def whole_cycle(period: float, samples: int) -> int:
    """Return the shortest whole cycle worth comparing, in samples; 0 where there is none.

    Args:
        period: Samples in a period, > 0.
        samples: How many samples repeat; many cycles of them, or nothing is worth it.
    """
    for periods in range(1, _MOST_PERIODS + 1):
        length = periods * period
        if length > LONG or 4 * length > samples:
            return 0
        if abs(length - round(length)) * (samples / length) <= _WHOLE:
            times = max(1, math.ceil(_LEAST_CYCLE / length))
            cycle = times * round(length)
            return cycle if 4 * cycle <= samples else 0
    return 0
