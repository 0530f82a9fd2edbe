"""What stands between an emulated device's terminals and the rig."""

from dataclasses import dataclass

from hilctl_drivers.profile_parts import Range
from hilctl_drivers.simulated.terfenol import TerfenolParameters


@dataclass(frozen=True, slots=True)
class Wiring:
    """What stands between the device's terminals and the rig.

    Attributes:
        gain_a: Amplifier, A for one unit of the output.
        offset_a: Current at 0 of the output.
        sensor_um: Sensor, um for one unit of the input.
        offset_um: Displacement at 0 of the input.
    """

    gain_a: float
    offset_a: float
    sensor_um: float
    offset_um: float

    @classmethod
    def spread(cls, output: Range, sensor: Range) -> "Wiring":
        """Return a wiring that spreads the rig's ranges over those of the two channels.

        An output in A drives the coil itself.
        """
        rig = TerfenolParameters()
        gain_a, offset_a = _spread(output, rig.dac_range_a)
        if output.unit == "A":
            gain_a, offset_a = 1.0, 0.0
        return cls(gain_a, offset_a, *_spread(sensor, rig.sensor_range_um))


def _spread(channel: Range, reach: float) -> tuple[float, float]:
    gain = 2.0 * reach / (channel.max - channel.min)
    return gain, -0.5 * gain * (channel.max + channel.min)
