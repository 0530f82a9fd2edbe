"""The on-target flag of an axis, with an event per change."""

from typing import Annotated

import numpy as np

from hilctl.base.events import ON_TARGET, Event
from hilctl.base.samples import BlockHeader
from hilctl.base.strict import Field, StrictModel
from hilctl.kernels import on_target as kernels
from hilctl.kernels.jit import compiled
from hilctl.loop.block import Block
from hilctl.loop.interlocks import in_samples

_FIRST_SAMPLE = int(BlockHeader.FIRST_SAMPLE)
_EVENT_EVERY_S = 0.1


class OnTargetSettings(StrictModel):
    """Tolerance and settling time of the on-target flag.

    Attributes:
        tolerance_um: Largest |reference - displacement| of an axis on target, um.
        settle_s: Time for which all samples must be within the tolerance, s.
    """

    tolerance_um: Annotated[float, Field(gt=0.0)]
    settle_s: Annotated[float, Field(ge=0.0)] = 0.0


class OnTarget:
    """Flag the samples of an axis that are on target."""

    def __init__(self, settings: OnTargetSettings, sample_rate_hz: float) -> None:
        samples = max(1.0, in_samples(settings.settle_s, sample_rate_hz))
        self._limits = settings.tolerance_um, samples
        self._memory = np.zeros(kernels.MEMORY)
        self._changed_at, self._event_at = 0, 0.0
        self._event_after = _EVENT_EVERY_S * sample_rate_hz
        self._on_target_block = compiled(kernels.on_target_block)

    @property
    def active(self) -> bool:
        """Whether the last sample was on target."""
        return bool(self._memory[kernels.ON])

    def take(self, block: Block) -> Event | None:
        """Flag the samples of the next block; return an event of the last change.

        Changes within 0.1 s of an event are counted in the next one.
        """
        first, memory = block.head[_FIRST_SAMPLE], self._memory
        if block.skipped:
            memory[kernels.RUN] = 0.0
        signals = block.reference, block.displacement_um, block.flags
        k = self._on_target_block(*self._limits, memory, *signals)
        if k >= 0:
            self._changed_at = first + k
        if not memory[kernels.CHANGES] or first < self._event_at:
            return None
        self._event_at = first + self._event_after
        values = {"on": float(memory[kernels.ON]), "changes": float(memory[kernels.CHANGES])}
        memory[kernels.CHANGES] = 0.0
        text = f"{'within' if self.active else 'outside'} {self._limits[0]:g} µm of the reference"
        return Event(self._changed_at, "info", ON_TARGET, text, values)
