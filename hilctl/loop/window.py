"""Reference and input of the samples that come next, where all of them do not fit in memory.

Sample ``k`` of the waveform stands at ``k % size`` of both arrays, so a block never lies across
their ends: their size is a multiple of it. Somebody ahead of the loop fills them.
"""

from typing import Protocol

_LEAST_SAMPLES = 1 << 18
_LEAST_S = 4.0


class Window(Protocol):
    """How far they are filled."""

    @property
    def samples(self) -> int:
        """Samples of the waveform."""
        ...

    def has(self, stop: int) -> bool:
        """Return whether all samples before ``stop`` are there, once those before a block are used.

        Never waits for anybody else.
        """
        ...


def window_size(block: int, sample_rate_hz: float) -> int:
    """Return the samples of a window: some seconds of whole blocks."""
    return -(-max(_LEAST_SAMPLES, round(_LEAST_S * sample_rate_hz)) // block) * block
