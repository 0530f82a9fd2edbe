"""A spring on a current amplifier, with a displacement sensor: a whole device in one module.

It stands for hardware that this computer could not have: where it works out the spring, yours calls
its driver. All that it needs of hilctl are the four names below.
"""

from typing import ClassVar

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from hilctl.base import Device, DeviceError, DeviceInfo, DeviceOptions

F64 = NDArray[np.float64]
RANGE_UM = 200.0


class SpringOptions(DeviceOptions):
    """What an experiment may say under ``device``, checked with file and line."""

    um_per_a: float = Field(default=10.0, gt=0.0, description="displacement of one ampere, um")
    lag_s: float = Field(default=0.002, gt=0.0, description="time constant of the amplifier, s")
    current_max_a: float = Field(default=5.0, gt=0.0, description="largest current, A")


class Spring(Device):
    """A displacement that follows the current with a first-order lag."""

    Options: ClassVar[type[DeviceOptions]] = SpringOptions

    def __init__(self, options: SpringOptions) -> None:
        """Describe the device; nothing is opened yet."""
        self._options = options
        self._info = DeviceInfo(
            name="spring",
            description=f"spring of {options.um_per_a:g} um/A",
            command_unit="A",
            command_min=-options.current_max_a,
            command_max=options.current_max_a,
            sensor_min_um=-RANGE_UM,
            sensor_max_um=RANGE_UM,
            max_rate_hz=10_000.0,
            simulated=True,
            details={"um_per_a": f"{options.um_per_a:g}"},
        )
        self._block = 0
        self._step = 0.0
        self._current_a = 0.0

    @property
    def info(self) -> DeviceInfo:
        """What the device is and what it accepts; constant."""
        return self._info

    def open(self, sample_rate_hz: float, block: int) -> None:
        """Get ready; the output stays where it is."""
        if not 0.0 < sample_rate_hz <= self._info.max_rate_hz:
            highest_hz = self._info.max_rate_hz
            raise DeviceError(
                f"spring: sample rate must be in (0, {highest_hz:g}] Hz, got {sample_rate_hz:g}"
            )
        self._block = block
        self._step = 1.0 - float(np.exp(-1.0 / (sample_rate_hz * self._options.lag_s)))

    def output(self) -> float:
        """Return the current that it puts out; it keeps it while it is not open."""
        if not self._block:
            raise DeviceError("spring: is not open")
        return self._current_a

    def exchange(
        self, first_sample: int, command: F64, displacement_um: F64, measured: F64
    ) -> None:
        """Read the sensor, then put the next current out, for each sample of the block."""
        if command.size != self._block:
            state = f"a block of {self._block}" if self._block else "an open device"
            raise DeviceError(f"spring: sample {first_sample} needs {state}")
        # All of the block before any of it: a device never clips, and sends nothing of a bad one.
        for value in command:
            self._check(float(value))
        for index, value in enumerate(command):
            displacement_um[index] = self._options.um_per_a * self._current_a
            self._current_a += self._step * (float(value) - self._current_a)

    def make_safe(self, command: float) -> None:
        """Put the output at ``command`` at once; it needs no open device."""
        self._check(command)
        self._current_a = command

    def close(self) -> None:
        """Let go and leave the output as it is; twice is fine."""
        self._block = 0

    def _check(self, value: float) -> None:
        """Refuse a current out of range or not a number, which no comparison holds for."""
        highest_a = self._options.current_max_a
        if not -highest_a <= value <= highest_a:
            raise DeviceError(
                f"spring: current must be in [{-highest_a:g}, {highest_a:g}] A, got {value} A, "
                "nothing was sent"
            )
