"""What stands between a DAC's terminals and the actuator: amplifier, sensor, and their calibration.

The device's profile says what its terminals do; these options of the experiment say what they are
wired to. command = gain * output + offset, displacement = sensitivity * input + offset.
"""

from typing import Self

from pydantic import Field, model_validator

from hilctl.base.device import CommandUnit, DeviceOptions
from hilctl.base.errors import InputError
from hilctl_drivers.profile_parts import Range


class Amplifier(DeviceOptions):
    """The power amplifier after the output; one of the gains."""

    gain_a_per_v: float | None = Field(default=None, description="coil current of one volt")
    gain_a_per_ma: float | None = Field(default=None, description="coil current of one milliampere")
    gain_v_per_v: float | None = Field(default=None, description="drive voltage of one volt")
    gain_v_per_ma: float | None = Field(default=None, description="drive voltage of one mA")
    offset_a: float = Field(default=0.0, description="coil current at 0 of the output")
    offset_v: float = Field(default=0.0, description="drive voltage at 0 of the output")

    @model_validator(mode="after")
    def _one_gain(self) -> Self:
        given = [gain for gain in self._gains.values() if gain is not None]
        if len(given) != 1 or given[0] == 0.0:
            raise ValueError(f"must have one of {', '.join(self._gains)}, and not 0")
        wrong = self.offset_v if self.command_unit == "A" else self.offset_a
        if wrong:
            raise ValueError("offset must be in the unit that the gain leads to")
        return self

    @property
    def _gains(self) -> dict[str, float | None]:
        return {
            "gain_a_per_v": self.gain_a_per_v,
            "gain_a_per_ma": self.gain_a_per_ma,
            "gain_v_per_v": self.gain_v_per_v,
            "gain_v_per_ma": self.gain_v_per_ma,
        }

    @property
    def command_unit(self) -> CommandUnit:
        """Unit of what drives the actuator."""
        current = (self.gain_a_per_v, self.gain_a_per_ma)
        return "V" if current == (None, None) else "A"

    @property
    def output_unit(self) -> str:
        """Unit of the output that it is wired to."""
        volts = (self.gain_a_per_v, self.gain_v_per_v)
        return "mA" if volts == (None, None) else "V"

    @property
    def gain(self) -> float:
        """Command for one unit of the output."""
        return next(gain for gain in self._gains.values() if gain is not None)

    @property
    def offset(self) -> float:
        """Command at 0 of the output."""
        return self.offset_a + self.offset_v


class Sensor(DeviceOptions):
    """The displacement sensor before the input; one of the sensitivities."""

    um_per_v: float | None = Field(default=None, description="displacement of one volt, um")
    um_per_ma: float | None = Field(default=None, description="displacement of one mA, um")
    offset_um: float = Field(default=0.0, description="displacement at 0 of the input, um")

    @model_validator(mode="after")
    def _one_sensitivity(self) -> Self:
        given = [each for each in (self.um_per_v, self.um_per_ma) if each is not None]
        if len(given) != 1 or given[0] == 0.0:
            raise ValueError("must have one of um_per_v and um_per_ma, and not 0")
        return self

    @property
    def input_unit(self) -> str:
        """Unit of the input that it is wired to."""
        return "mA" if self.um_per_v is None else "V"

    @property
    def um_per_unit(self) -> float:
        """Displacement for one unit of the input, um."""
        return self.um_per_v or self.um_per_ma or 0.0


class Calibration(DeviceOptions):
    """When and by whom gain and sensitivity were found; kept with each recording."""

    date: str = Field(description="day of the calibration")
    by: str = Field(description="who did it")
    reference: str = Field(description="against what, or where it is written down")


class SignalChain:
    """Commands to output values and input values to displacements.

    Args:
        output: The output's range.
        sensor_input: The input's range.
        amplifier: Between output and actuator; None where an output in A drives the coil itself.
        sensor: Between actuator and input.

    Raises:
        InputError: Units that don't go together.
    """

    def __init__(
        self, output: Range, sensor_input: Range, amplifier: Amplifier | None, sensor: Sensor
    ) -> None:
        if amplifier is None and output.unit != "A":
            raise InputError(f"amplifier is required: the output is in {output.unit}")
        if amplifier is not None and amplifier.output_unit != output.unit:
            raise InputError(
                f"amplifier takes {amplifier.output_unit}, but the output is in {output.unit}"
            )
        if sensor.input_unit != sensor_input.unit:
            raise InputError(
                f"sensor gives {sensor.input_unit}, but the input is in {sensor_input.unit}"
            )
        self.command_unit: CommandUnit = "A" if amplifier is None else amplifier.command_unit
        self._gain = 1.0 if amplifier is None else amplifier.gain
        self._offset = 0.0 if amplifier is None else amplifier.offset
        self._um_per_unit = sensor.um_per_unit
        self._offset_um = sensor.offset_um

    @property
    def factors(self) -> tuple[float, float, float, float]:
        """Gain and offset of the command, sensitivity and offset of the displacement."""
        return self._gain, self._offset, self._um_per_unit, self._offset_um

    def output(self, command: float) -> float:
        """Return the output value of a command."""
        return (command - self._offset) / self._gain

    def command(self, output: float) -> float:
        """Return the command of an output value."""
        return output * self._gain + self._offset

    def displacement_um(self, value: float) -> float:
        """Return the displacement of an input value, um."""
        return value * self._um_per_unit + self._offset_um

    def command_range(self, low: float, high: float) -> tuple[float, float]:
        """Return lowest and highest command of an output's range."""
        ends = sorted((self.command(low), self.command(high)))
        return ends[0], ends[1]

    def displacement_range(self, low: float, high: float) -> tuple[float, float]:
        """Return lowest and highest displacement of an input's range, um."""
        ends = sorted((self.displacement_um(low), self.displacement_um(high)))
        return ends[0], ends[1]
