"""What can happen to a sample, as bits of the recorded ``flags``."""

from enum import IntFlag


class Flag(IntFlag):
    """Bits of a sample's ``flags``."""

    RANGE_LIMITED = 1
    """The wanted command was outside the limits' range."""
    SLEW_LIMITED = 2
    """The wanted command asked for more slew than the limits allow."""
    INVALID = 4
    """The wanted command was not finite; the last command was held."""
    RAMP = 8
    """On the way out: the ramp to the safe value, without a reference."""
    SENSOR_INVALID = 16
    """The displacement was not finite, outside the stroke limits or at an end of the sensor."""
    UNANSWERED = 32
    """The device did not answer the exchange: the command may not have reached it."""
    SENSOR_FROZEN = 64
    """The displacement had not changed for too long while the command moved."""
    DEVIATION = 128
    """The measured command was too far from the one put out for too long, or was lost."""
    THERMAL = 256
    """The thermal budget of the coil was used up."""
    TRACKING_ERROR = 512
    """The displacement was too far from the reference for too long."""
