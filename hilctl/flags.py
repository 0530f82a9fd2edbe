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
    """The displacement was not finite or outside the stroke limits."""
