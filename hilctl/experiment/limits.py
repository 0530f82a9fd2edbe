"""The optional keys of an experiment's ``limits`` that set its interlocks."""

from typing import Annotated

from pydantic import Field

from hilctl.base.strict import Strict


class InterlockKeys(Strict):
    """What ends a run by its way out beside the stroke; what is not given is not looked at."""

    rms_current_a: Annotated[float, Field(gt=0.0)] | None = Field(
        default=None,
        description="largest running rms of the coil current, commanded or measured, A; every run"
        " starts with the coil at the heat of the safe value",
    )
    thermal_time_constant_s: Annotated[float, Field(gt=0.0)] | None = Field(
        default=None, description="time constant of the coil's heating, s"
    )
    tracking_error_um: Annotated[float, Field(gt=0.0)] | None = Field(
        default=None, description="largest |reference - displacement| of a compensated run, um"
    )
    tracking_s: Annotated[float, Field(ge=0.0)] | None = Field(
        default=None, description="time for which it may be larger, s; 0 where not given"
    )
    frozen_s: Annotated[float, Field(gt=0.0)] | None = Field(
        default=None,
        description="time for which the displacement may stay the same after the command has moved"
        " by 2 % of its range, s",
    )
    frozen_um: Annotated[float, Field(ge=0.0)] | None = Field(
        default=None,
        description="largest change of the displacement that counts as none, um; 0 where not given",
    )
    measured_deviation_a: Annotated[float, Field(gt=0.0)] | None = Field(
        default=None, description="largest distance of the measured current from the command, A"
    )
    measured_deviation_v: Annotated[float, Field(gt=0.0)] | None = Field(
        default=None, description="largest distance of the measured drive from the command, V"
    )
    deviation_s: Annotated[float, Field(ge=0.0)] | None = Field(
        default=None, description="time for which it may be larger, s; 0 where not given"
    )
