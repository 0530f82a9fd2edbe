"""What a real actuator has beside its rods, and the rated one leaves out: options of the rig."""

from typing import Annotated, TypeAlias

from hilctl.base.device import DeviceOptions
from hilctl.base.strict import Field

TimeConstant: TypeAlias = Annotated[float, Field(ge=1e-3, le=1e5)]


class CreepEffect(DeviceOptions):
    """Creep of the displacement after every change: springs and dampers in series with the rods.

    Each time constant adds its share of the rods' displacement, late by first order. Time constants
    a decade apart give a creep with the logarithm of time, as K. Kuhnen and H. Janocha, "Inverse
    feedforward controller for complex hysteretic nonlinearities in smart-material systems", Control
    and Intelligent Systems 29 (2001) 74, and D. Croft, G. Shed and S. Devasia, "Creep, hysteresis,
    and vibration compensation for piezoactuators", J. Dyn. Syst. Meas. Control 123 (2001) 35.
    """

    share: float = Field(
        gt=0.0, le=0.3, description="creep that all time constants come to, per displacement"
    )
    time_constants_s: tuple[TimeConstant, ...] = Field(
        default=(0.1, 1.0, 10.0, 100.0),
        min_length=1,
        max_length=8,
        description="time constants, s; each has the same share",
    )


class Thermal(DeviceOptions):
    """Growth of rods that the coil's own I^2 R warms, and that stand in a room."""

    rise_k_per_a2: float = Field(
        ge=0.0, le=10.0, description="rise that a steady current comes to, per its square, K/A^2"
    )
    tau_s: float = Field(ge=0.1, le=1e5, description="time constant of the rise, s")
    growth_um_per_k: float = Field(
        ge=-5.0, le=5.0, description="growth of the displacement with the temperature, um/K"
    )
    ambient_k: float = Field(
        default=0.0,
        ge=-20.0,
        le=20.0,
        description="temperature of the room above that at which the sensor was set to zero, K",
    )


class SecondMode(DeviceOptions):
    """A second mode of the structure, which stays where it is with any load."""

    frequency_hz: float = Field(ge=50.0, le=20e3, description="its natural frequency, Hz")
    damping_ratio: float = Field(ge=0.001, le=1.0, description="its damping ratio")
    share: float = Field(
        ge=-0.5,
        le=0.5,
        description="its share of the static displacement; negative where it moves the head against"
        " the first",
    )


class VoltageLimit(DeviceOptions):
    """An amplifier whose voltage is limited: no current changes faster than that drives it.

    The voltages that rods in motion induce are left out.
    """

    voltage_max_v: float = Field(gt=0.0, le=1e3, description="largest voltage either way, V")
    resistance_ohm: float = Field(gt=0.0, le=1e3, description="resistance of the coil, ohm")
    inductance_h: float = Field(gt=0.0, le=10.0, description="inductance of the coil, H")
