"""What all simulated rigs share as devices: they step on sample count, so no run needs real time.

Time passes only in :meth:`SimulatedDevice.exchange`: one sample period a command, however long the
caller took. That is how a device with a sample clock and a FIFO of its own looks from outside, so
they all call themselves buffered.
"""

from abc import ABC, abstractmethod
from typing import ClassVar, Literal

import numpy as np
from pydantic import Field

from hilctl.base.arrays import F64
from hilctl.base.device import DeviceInfo, DeviceOptions
from hilctl.base.errors import DeviceError
from hilctl_drivers.simulated.plant import Plant

FIFO_DEPTH = 4096
MAX_RATE_HZ = 200e3


class Fault(DeviceOptions):
    """A fault to inject, for trying what a run does about it. It stays once it has come."""

    kind: Literal["sensor_nan", "sensor_frozen", "sensor_jump", "no_answer", "refused"] = Field(
        description="sensor_nan: readings are not numbers; sensor_frozen: the last good reading"
        " is repeated; sensor_jump: readings are off by half the sensor's range; no_answer:"
        " exchanges time out; refused: exchanges are turned down"
    )
    at_sample: int = Field(ge=0, description="first sample that has the fault")


class SimulatedOptions(DeviceOptions):
    """Options of every simulated device."""

    seed: int = Field(default=1, ge=0, description="seed of the sensor noise")
    noise: bool = Field(default=True, description="whether the sensor has noise")
    fault: Fault | None = Field(default=None, description="fault to inject")


class SimulatedDevice(ABC):
    """A :class:`~hilctl.base.device.Device` around a plant; opening it puts the plant at rest."""

    Options: ClassVar[type[DeviceOptions]] = SimulatedOptions

    def __init__(self, info: DeviceInfo, fault: Fault | None) -> None:
        """Take what the subclass says of itself, and the fault to inject."""
        self._info = info
        self._fault = fault
        self._plant: Plant | None = None
        self._block = 0
        self._next_sample = 0
        self._last_command = 0.0
        self._last_reading_um = 0.0

    @property
    def info(self) -> DeviceInfo:
        """What the device is and what it accepts."""
        return self._info

    @property
    def last_command(self) -> float:
        """What the output is at, in ``info.command_unit``."""
        return self._last_command

    def open(self, sample_rate_hz: float, block: int) -> None:
        """Put the plant at rest, with 0 at the output and the sample count at 0.

        Raises:
            DeviceError: The rate or the block is out of range.
        """
        if not 0.0 < sample_rate_hz <= self._info.max_rate_hz:
            rule = f"sample rate must be in (0, {self._info.max_rate_hz:g}] Hz"
            raise self._error(rule, sample_rate_hz)
        if not 1 <= block <= FIFO_DEPTH:
            rule = f"block must be in [1, {FIFO_DEPTH}] samples"
            raise self._error(rule, block)
        self._plant = self._build(sample_rate_hz)
        self._block = block
        self._next_sample = 0
        self._last_command = 0.0
        self._last_reading_um = 0.0

    def exchange(
        self, first_sample: int, command: F64, displacement_um: F64, measured: F64
    ) -> None:
        """Let a period pass for each command, see :meth:`hilctl.base.device.Device.exchange`.

        Samples skipped since the last block pass too, with the output held.

        Raises:
            DeviceError: Not open; a command out of range or not finite; blocks of unequal length
                or longer than agreed; samples that have already passed; an injected fault.
        """
        if self._plant is None:
            raise self._error("must be open to exchange", "closed")
        sizes = (command.size, displacement_um.size, measured.size)
        if not 1 <= sizes[0] <= self._block or len(set(sizes)) > 1:
            rule = f"command, displacement and measured must be 1..{self._block} samples each"
            raise self._error(rule, sizes)
        self._check(command)
        if first_sample < self._next_sample:
            rule = f"first sample must be >= {self._next_sample}, which is next"
            raise self._error(rule, first_sample)
        self._fail_exchange(first_sample + command.size)
        if first_sample > self._next_sample:
            self._plant.hold(first_sample - self._next_sample, self._last_command)
        self._plant.step(command, displacement_um, measured)
        self._spoil(first_sample, displacement_um)
        self._next_sample = first_sample + command.size
        self._last_command = float(command[-1])
        self._last_reading_um = float(displacement_um[-1])

    def make_safe(self, command: float) -> None:
        """Put the output at ``command``, open or not; an injected fault does not prevent it.

        Raises:
            DeviceError: ``command`` is out of range or not finite.
        """
        self._check(np.array([command]))
        self._last_command = command

    def close(self) -> None:
        """Let go of the plant. Closing twice is fine."""
        self._plant = None

    @abstractmethod
    def _build(self, sample_rate_hz: float) -> Plant:
        """Return a plant at rest."""

    def _error(self, rule: str, value: object) -> DeviceError:
        return DeviceError(f"{self._info.name}: {rule}, got {value}")

    def _check(self, command: F64) -> None:
        """Refuse a block with a command that is out of range or not a number."""
        info = self._info
        good = (command >= info.command_min) & (command <= info.command_max)
        if good.all():
            return
        index = int(np.argmin(good))
        unit = info.command_unit
        rule = f"command[{index}] must be in [{info.command_min:g}, {info.command_max:g}] {unit}"
        raise self._error(rule, f"{command[index]} {unit}, nothing was sent")

    def _fail_exchange(self, end_sample: int) -> None:
        """Raise what an injected fault of the connection raises in a block that ends here."""
        fault = self._fault
        if fault is None or end_sample <= fault.at_sample:
            return
        if fault.kind == "no_answer":
            raise self._error("must answer an exchange in time", "no answer (injected fault)")
        if fault.kind == "refused":
            raise self._error("must accept the block", "a refusal (injected fault)")

    def _spoil(self, first_sample: int, displacement_um: F64) -> None:
        """Put an injected sensor fault on the readings it has reached."""
        fault = self._fault
        if fault is None or first_sample + displacement_um.size <= fault.at_sample:
            return
        start = max(0, fault.at_sample - first_sample)
        good = self._last_reading_um if start == 0 else displacement_um[start - 1]
        spoilt = displacement_um[start:]
        if fault.kind == "sensor_nan":
            spoilt[:] = np.nan
        elif fault.kind == "sensor_frozen":
            spoilt[:] = good
        elif fault.kind == "sensor_jump":
            spoilt += 0.5 * self._info.sensor_max_um
            np.minimum(spoilt, self._info.sensor_max_um, out=spoilt)
