"""The ``limits`` of an experiment: what limiter and interlocks hold the run to."""

from typing import Annotated, Self

from hilctl.base.strict import Field, model_validator
from hilctl.base.units import CommandUnit
from hilctl.experiment.parts import Interval
from hilctl.loop.interlocks import InterlockSettings


class Limits(InterlockSettings):
    """What the limiter and the interlocks hold the run to; the limiter is last before the device.

    Attributes:
        peak_current_a: Largest magnitude of the coil current, for devices driven in A.
        slew_a_per_s: Fastest change of the coil current.
        drive_v: Lowest and highest drive voltage, for devices driven in V.
        slew_v_per_s: Fastest change of the drive voltage.
        stroke_um: Displacements that the sensor may show; outside, the run ends by its safe ramp.
    """

    peak_current_a: Annotated[float, Field(gt=0.0)] | None = None
    slew_a_per_s: Annotated[float, Field(gt=0.0)] | None = None
    drive_v: Interval | None = None
    slew_v_per_s: Annotated[float, Field(gt=0.0)] | None = None
    stroke_um: Interval

    @model_validator(mode="after")
    def _one_unit(self) -> Self:
        current = (self.peak_current_a, self.slew_a_per_s)
        voltage = (self.drive_v, self.slew_v_per_s)
        complete = None not in current or None not in voltage
        mixed = any(v is not None for v in current) and any(v is not None for v in voltage)
        if mixed or not complete:
            raise ValueError(
                "must have either peak_current_a and slew_a_per_s (a device driven in A) or "
                "drive_v and slew_v_per_s (a device driven in V)"
            )
        return self

    @property
    def unit(self) -> CommandUnit:
        """Unit of the commands that are limited."""
        return "V" if self.drive_v is not None else "A"

    @property
    def command_range(self) -> tuple[float, float]:
        """Lowest and highest command, in :attr:`unit`."""
        if self.drive_v is not None:
            return self.drive_v
        peak = self.peak_current_a or 0.0
        return -peak, peak

    @property
    def slew_per_s(self) -> float:
        """Fastest change of the command, in :attr:`unit` a second."""
        return self.slew_v_per_s or self.slew_a_per_s or 0.0
