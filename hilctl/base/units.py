"""Units of what is sent to a device."""

from typing import Literal, TypeAlias

CommandUnit: TypeAlias = Literal["A", "V"]
"""Coil current in ampere, or drive voltage in volt."""
