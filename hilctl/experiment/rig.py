"""The rig of a run: what the rules of all sections share of device, rate and limits."""

import math
from dataclasses import dataclass
from typing import NamedTuple

from hilctl.base.device import DeviceInfo, VoltageLimit
from hilctl.base.types import CommandUnit
from hilctl.loop.interlocks import AuxLimit, InterlockContext, InterlockSettings
from hilctl.loop.limiter import CommandLimits

_TRAVEL = 0.02  # of the command's range: far above noise, far below any useful run


class Exchange(NamedTuple):
    """Timing of a loop: samples per second, samples per exchange, and exchanges to an answer."""

    rate_hz: float
    block: int = 1
    latency_blocks: int = 0


@dataclass(frozen=True, slots=True)
class RunRig:
    """Device, rate and limits of a run.

    Attributes:
        info: Facts of the device.
        exchange: Timing of the loop.
        unit: Unit of the limited commands; a rule compares it with the device's.
        command: Limits of the command, with the safe value.
        stroke_um: Lowest and highest measured displacement.
        interlocks: Settings of the interlocks, with the default for a compensated run.
        aux_limits: Limits of auxiliary channels by name.
        amplifier: Largest voltage of the amplifier; None: not checked.
        ramp_s: Duration of the safe ramp.
    """

    info: DeviceInfo
    exchange: Exchange
    unit: CommandUnit
    command: CommandLimits
    stroke_um: tuple[float, float]
    interlocks: InterlockSettings
    aux_limits: dict[str, float | tuple[float, float]]
    amplifier: VoltageLimit | None
    ramp_s: float

    @property
    def tick_s(self) -> float:
        """Time from one tick to the next, in s."""
        return self.exchange.block / self.exchange.rate_hz

    @property
    def lead_in_samples(self) -> int:
        """Length of the lead-in from the initial displacement to the reference, in samples."""
        return max(1, round(self.ramp_s * self.exchange.rate_hz))

    @property
    def aux(self) -> tuple[AuxLimit, ...]:
        """The auxiliary channels of the device with their limits."""
        found = []
        for channel in self.info.aux:
            span = self.aux_limits.get(channel.name, math.inf)
            low, high = span if isinstance(span, tuple) else (-math.inf, span)
            found.append(AuxLimit(channel, low, high))
        return tuple(found)

    def interlock_context(self, heat_a2: float = 0.0) -> InterlockContext:
        """Return the facts that the interlocks need; ``heat_a2`` is the coil's heat before."""
        return InterlockContext(
            stroke_um=self.stroke_um,
            sensor_um=(self.info.sensor_min_um, self.info.sensor_max_um),
            unit=self.unit,
            safe=self.command.safe,
            frozen_travel=_TRAVEL * (self.command.high - self.command.low),
            heat_a2=heat_a2,
            aux=self.aux,
        )
