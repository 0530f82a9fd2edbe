"""The optional section ``feedback`` of the experiment file."""

from typing import Annotated, Self

from pydantic import Field, model_validator

from hilctl.base.strict import Strict


class FeedbackConfig(Strict):
    """A PI controller around the compensator, for devices that exchange sample by sample.

    Attributes:
        limit_um: Largest correction of the compensator's input, either way.
        bandwidth_hz: Frequency up to which the error is brought down; gives the gains.
        kp: Proportional gain, um of correction per um of error, where there is no bandwidth.
        ki_per_s: Integral gain, per s, where there is no bandwidth.
        sensor_delay_s: Age of a displacement when it is read, as far as the model does not know it:
            the filter of the sensor, its line.
        resonance_hz: Lowest natural frequency of the actuator with its load; the feedback must stay
            well below it. Left out, that of the model's structure.
        damping_ratio: Damping of that resonance.
    """

    limit_um: Annotated[float, Field(gt=0.0)]
    bandwidth_hz: Annotated[float, Field(gt=0.0)] | None = None
    kp: Annotated[float, Field(ge=0.0)] | None = None
    ki_per_s: Annotated[float, Field(gt=0.0)] | None = None
    sensor_delay_s: Annotated[float, Field(ge=0.0)] = 0.0
    resonance_hz: Annotated[float, Field(gt=0.0)] | None = None
    damping_ratio: Annotated[float, Field(gt=0.0, le=2.0)] | None = None

    @model_validator(mode="after")
    def _one_way(self) -> Self:
        by_gains = self.kp is not None or self.ki_per_s is not None
        if by_gains == (self.bandwidth_hz is not None) or (by_gains and self.ki_per_s is None):
            raise ValueError("must have either bandwidth_hz or ki_per_s, the latter with kp or not")
        return self
