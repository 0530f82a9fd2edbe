"""Simulated rigs as devices: ``simulated_terfenol`` and ``simulated_piezo``."""

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Annotated, Any, ClassVar, Self, TypeAlias

from hilctl.base.device import AuxChannel, DeviceOptions, VoltageLimit
from hilctl.base.strict import Field, ValidationInfo, field_validator, model_validator
from hilctl.base.types import F64
from hilctl_drivers.simulated.actuator_base import Plant, RodParameters
from hilctl_drivers.simulated.piezo import PiezoActuator, PiezoParameters
from hilctl_drivers.simulated.pinned_cells import PinnedCellsParameters
from hilctl_drivers.simulated.simulated_device import SimulatedDevice, SimulatedOptions
from hilctl_drivers.simulated.terfenol import (
    CreepEffect,
    SecondMode,
    TerfenolActuator,
    TerfenolParameters,
    Thermal,
)

RATED_CURRENT_A = 7.07  # 5 A rms through the published coil


Factor: TypeAlias = Annotated[float, Field(ge=0.5, le=2.0)]


class Variation(DeviceOptions):
    """Factors on the rated actuator, to test a model of another actuator."""

    lag: Factor = Field(default=1.0, description="time constant of the field")
    pinning: Factor = Field(default=1.0, description="pinning fields, the width of the loops")
    strain: float = Field(
        default=1.0, gt=0.0, le=2.0, description="displacement, the gain of the rig"
    )
    resonance: Factor = Field(default=1.0, description="natural frequency, by the stiffness")
    damping: Factor = Field(default=1.0, description="damping ratio")

    def of(self, rated: TerfenolParameters) -> TerfenolParameters:
        """Return an actuator that differs from ``rated`` by these factors."""
        return replace(
            rated,
            rods=rated.rods.varied(self.lag, self.pinning, self.strain),
            stiffness_n_per_m=rated.stiffness_n_per_m * self.resonance**2,
            damping_ratio=rated.damping_ratio * self.damping,
        )


class Drift(DeviceOptions):
    """Slow growth of the displacement, as of rods that warm up: ``um * (1 - exp(-t / tau_s))``."""

    um: float = Field(ge=-50.0, le=50.0, description="final displacement, um")
    tau_s: float = Field(gt=0.0, description="its time constant, s")


class CoilTemperatures(DeviceOptions):
    """Temperatures of coil and rods by the coil's loss; they do not act on the displacement.

    The coil warms by first order to ``coil_k_per_w`` R i^2 above the room, and the rods to a share
    of the coil's rise.
    """

    ambient_c: float = Field(default=23.0, ge=-50.0, le=100.0, description="of the room, degC")
    resistance_ohm: float = Field(default=2.0, gt=0.0, le=1e3, description="of the coil, ohm")
    coil_k_per_w: float = Field(
        default=1.0, gt=0.0, le=1e3, description="final rise of the coil per watt, K/W"
    )
    coil_tau_s: float = Field(default=60.0, ge=1e-3, description="its time constant, s")
    rod_share: float = Field(
        default=0.5, ge=0.0, le=1.0, description="final rise of the rods per rise of the coil"
    )
    rod_tau_s: float = Field(default=300.0, ge=1e-3, description="its time constant, s")

    def warm(self, aux: F64, square_a2: float, time_s: float) -> None:
        """Advance the temperatures of coil and rods, float64[2], at a mean square of current."""
        coil, rod = aux.tolist()
        end = self.ambient_c + self.coil_k_per_w * self.resistance_ohm * square_a2
        coil += (end - coil) * -math.expm1(-time_s / self.coil_tau_s)
        end = self.ambient_c + self.rod_share * (coil - self.ambient_c)
        aux[:] = coil, rod + (end - rod) * -math.expm1(-time_s / self.rod_tau_s)


_TEMPERATURES = (
    AuxChannel("coil_c", "°C", "temperature of the coil"),
    AuxChannel("rod_c", "°C", "temperature of the rods"),
)


class TerfenolOptions(SimulatedOptions):
    """Options of ``simulated_terfenol``."""

    RODS: ClassVar[type[RodParameters]] = PinnedCellsParameters

    load_kg: float = Field(default=0.0, ge=0.0, le=100.0, description="mass on the actuator, kg")
    magnet: bool = Field(
        default=True,
        description="whether permanent magnets bias the rods; without them and without bias_a the"
        " displacement is even in the current, and its loops are butterflies",
    )
    bias_a: float = Field(
        default=0.0,
        ge=-8.0,
        le=8.0,
        description="constant current added to the command, A; displacement is zero there",
    )
    rated_current_a: float = Field(
        default=RATED_CURRENT_A,
        gt=0.0,
        le=1e3,
        description="current of the rated field, A; another one than the default is another coil"
        " around the same rods, with a DAC whose range grows alike",
    )
    current_max_a: float | None = Field(
        default=None,
        gt=0.0,
        description="largest current accepted either way, bias and command together, A; default:"
        " the DAC's range, 10 A with the default coil",
    )
    vary: Variation = Field(
        default=Variation(), description="factors on the rated actuator, for tests of robustness"
    )
    drift: Drift | None = Field(default=None, description="slow growth of the displacement")
    creep: CreepEffect | None = Field(default=None, description="creep of the displacement")
    thermal: Thermal | None = Field(
        default=None, description="growth of the displacement with the rods' temperature"
    )
    temperatures: CoilTemperatures | None = Field(
        default=None,
        description="auxiliary channels coil_c and rod_c, the temperatures of coil and rods",
    )
    second_mode: SecondMode | None = Field(
        default=None, description="a mode of the structure beside the first"
    )
    amplifier: VoltageLimit | None = Field(
        default=None,
        validate_default=True,
        description="limit of the amplifier's voltage; default: that of the experiment",
    )

    @field_validator("amplifier", mode="before")
    @classmethod
    def _of_experiment(cls, value: Any, info: ValidationInfo) -> Any:
        return (info.context or {}).get("amplifier") if value is None else value

    @model_validator(mode="after")
    def _room(self) -> Self:
        low, high = self.command_range_a
        if not low < 0.0 < high:
            raise ValueError(
                f"bias_a must leave room for a command of either sign within current_max_a, or the"
                f" DAC's range without it: {self.bias_a:g} A"
            )
        return self

    @property
    def command_range_a(self) -> tuple[float, float]:
        """Lowest and highest command: including the bias it must stay within ``current_max_a``."""
        dac_a = TerfenolParameters().dac_range_a / self._turns
        most_a = dac_a if self.current_max_a is None else self.current_max_a
        low, high = -most_a - self.bias_a, most_a - self.bias_a
        return max(-dac_a, low), min(dac_a, high)

    @property
    def _turns(self) -> float:
        """Turns of the coil relative to the published one."""
        return RATED_CURRENT_A / self.rated_current_a

    def parameters(self) -> TerfenolParameters:
        """Return the actuator that the options describe."""
        rated, drift = TerfenolParameters(), self.drift or Drift(um=0.0, tau_s=1.0)
        made = replace(
            rated,
            dac_range_a=rated.dac_range_a / self._turns,
            coil_factor_per_m=rated.coil_factor_per_m * self._turns,
            magnet_field_a_per_m=rated.magnet_field_a_per_m if self.magnet else 0.0,
            sensor_noise_um=rated.sensor_noise_um if self.noise else 0.0,
            drift_um=drift.um,
            drift_s=drift.tau_s,
            rods=self.RODS(),
            creep=self.creep,
            thermal=self.thermal,
            second_mode=self.second_mode,
            amplifier=self.amplifier,
        )
        return self.vary.of(made)


class PiezoStage(DeviceOptions):
    """A stage of your own: a sum of play operators, for example one identified from your data."""

    drive_min_v: float = Field(default=0.0, le=0.0, description="bottom of the drive, V")
    drive_max_v: float = Field(gt=0.0, description="top of the drive, V")
    slope_um_per_v: float = Field(gt=0.0, description="weight p_0 of the drive itself")
    thresholds_v: tuple[float, ...] = Field(description="thresholds r_i of the play operators, V")
    weights_um_per_v: tuple[float, ...] = Field(description="weights p_i of the play operators")
    offset_um: float = Field(default=0.0, description="position at rest, um")
    sensor_range_um: float = Field(gt=0.0, description="reading at either end of the range, um")

    @model_validator(mode="after")
    def _same_length(self) -> Self:
        weights, thresholds = len(self.weights_um_per_v), len(self.thresholds_v)
        if weights != thresholds:
            raise ValueError(
                f"weights_um_per_v must have one value a threshold: {weights} for {thresholds}"
            )
        return self

    @classmethod
    def fitted(cls, drive_v: Sequence[float], range_um: float, rated_v: float) -> Self:
        """Return the published stage, scaled to another drive and another range of the sensor.

        ``rated_v`` moves it through 80 % of the sensor's range.
        """
        rated = PiezoParameters()
        volts, um = rated_v / rated.drive_max_v, 0.7 * range_um / rated.sensor_range_um
        return cls(
            drive_min_v=min(0.0, drive_v[0]),
            drive_max_v=max(map(abs, drive_v)),
            slope_um_per_v=rated.slope_um_per_v * um / volts,
            thresholds_v=tuple(each * volts for each in rated.thresholds_v),
            weights_um_per_v=tuple(each * um / volts for each in rated.weights_um_per_v),
            sensor_range_um=range_um,
        )


class PiezoOptions(SimulatedOptions):
    """Options of ``simulated_piezo``."""

    stage: PiezoStage | None = Field(
        default=None, description="a stage of your own instead of the published P-753.31C"
    )
    sensor_noise_um: float = Field(
        default=1e-3, ge=0.0, le=1.0, description="rms noise of each reading, um"
    )


class SimulatedTerfenol(SimulatedDevice):
    """The Terfenol-D actuator of :mod:`hilctl_drivers.simulated.terfenol`; commands in A."""

    Options: ClassVar[type[DeviceOptions]] = TerfenolOptions

    def __init__(self, options: TerfenolOptions) -> None:
        self._options = options
        self._parameters = options.parameters()
        command_min, command_max = options.command_range_a
        super().__init__(
            options,
            self._parameters,
            name="simulated_terfenol",
            description="simulated Terfenol-D actuator, linear amplifier and capacitive sensor",
            command_unit="A",
            command_min=command_min,
            command_max=command_max,
            command_step=self._parameters.dac_range_a / self._parameters.dac_codes,
            aux=_TEMPERATURES if options.temperatures else (),
        )

    def _open(self, sample_rate_hz: float, block: int) -> None:
        super()._open(sample_rate_hz, block)
        self._period_s = 1.0 / sample_rate_hz
        if self._options.temperatures is not None:
            self.aux[:] = self._options.temperatures.ambient_c

    def _follow(self, first_sample: int, command: F64, displacement_um: F64, measured: F64) -> None:
        before = self._next_sample
        super()._follow(first_sample, command, displacement_um, measured)
        if (temperatures := self._options.temperatures) is not None:
            current_a = measured + self._options.bias_a
            passed_s = (self._next_sample - before) * self._period_s
            temperatures.warm(self.aux, float(current_a @ current_a) / current_a.size, passed_s)

    def plant(self, sample_rate_hz: float) -> Plant:
        """Return the actuator at rest."""
        options = self._options
        return TerfenolActuator(
            self._parameters, sample_rate_hz, options.load_kg, options.bias_a, options.seed
        )


class SimulatedPiezo(SimulatedDevice):
    """A piezo stage of :mod:`hilctl_drivers.simulated`; commands in V of drive."""

    Options: ClassVar[type[DeviceOptions]] = PiezoOptions

    def __init__(self, options: PiezoOptions) -> None:
        self._seed = options.seed
        noise_um = options.sensor_noise_um if options.noise else 0.0
        stage = options.stage.model_dump() if options.stage else {}
        self._parameters = PiezoParameters(sensor_noise_um=noise_um, **stage)
        low_v, high_v = self._parameters.drive_min_v, self._parameters.drive_max_v
        drive = f"{low_v:g}..{high_v:g} V drive"
        super().__init__(
            options,
            self._parameters,
            name="simulated_piezo",
            description=f"simulated piezo stage, {drive} and capacitive sensor",
            command_unit="V",
            command_min=low_v,
            command_max=high_v,
            command_step=high_v / self._parameters.dac_codes,
        )

    def plant(self, sample_rate_hz: float) -> Plant:
        """Return the stage at rest."""
        return PiezoActuator(self._parameters, sample_rate_hz, self._seed)
