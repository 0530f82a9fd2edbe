"""What all simulated rigs share as devices: they step on sample count, so no run needs real time.

Time passes only in :meth:`SimulatedDevice.exchange`: one sample period a command, however long the
caller took. That is how a device with a sample clock and a FIFO of its own looks from outside, so
they all call themselves buffered.
"""

from abc import abstractmethod
from typing import ClassVar, Literal

import numpy as np

from hilctl.base.device import DeviceInfo, DeviceOptions
from hilctl.base.errors import DeviceError
from hilctl.base.strict import Field, StrictModel
from hilctl.base.types import F64
from hilctl_drivers.device import DacDevice
from hilctl_drivers.simulated.actuator_base import Plant

FIFO_DEPTH = 4096
MAX_RATE_HZ = 200e3
_SETTLING_S = 0.1


class SimulatedFault(StrictModel):
    """A fault to inject, for trying what a run does about it. It stays once it has come."""

    kind: Literal[
        "sensor_nan", "sensor_frozen", "sensor_jump", "sensor_inverted", "no_answer", "refused"
    ] = Field(
        description="sensor_nan: readings are not numbers; sensor_frozen: the last good reading"
        " is repeated; sensor_jump: readings are off by half the sensor's range; sensor_inverted:"
        " readings have the other sign; no_answer: exchanges time out; refused: exchanges are"
        " turned down"
    )
    at_sample: int = Field(ge=0, description="first sample that has the fault")


class SimulatedOptions(DeviceOptions):
    """Options of every simulated device."""

    seed: int = Field(default=1, ge=0, description="seed of the sensor noise")
    noise: bool = Field(default=True, description="whether the sensor has noise")
    fault: SimulatedFault | None = Field(default=None, description="fault to inject")
    output_at_open: float | None = Field(
        default=0.0,
        description="where the output stands when the device is opened, in its unit; null where the"
        " device is not to know, and then it is 0",
    )


class SimulatedDevice(DacDevice):
    """A :class:`~hilctl.base.device.Device` around a plant; opening it puts the plant at rest."""

    Options: ClassVar[type[DeviceOptions]] = SimulatedOptions

    def __init__(self, info: DeviceInfo, options: SimulatedOptions) -> None:
        """Take what the subclass says of itself, and the options that all share."""
        super().__init__(info, info.name, "exchange a block", "the output")
        self._fault = options.fault
        self._output_at_open = options.output_at_open
        self._plant: Plant | None = None
        self._next_sample = 0
        self._last_command = 0.0
        self._last_reading_um = 0.0

    def _longest_block(self) -> tuple[int, str]:
        return FIFO_DEPTH, ""

    def _open(self, sample_rate_hz: float, block: int) -> None:
        """Put the plant at rest where the output stands, with the sample count at 0."""
        del block
        self._plant = self._build(sample_rate_hz)
        self._next_sample = 0
        self._last_command = self._output_at_open or 0.0
        self._last_reading_um = 0.0
        if self._last_command:
            self._plant.hold(round(_SETTLING_S * sample_rate_hz), self._last_command)

    def _output(self) -> float | None:
        return None if self._output_at_open is None else self._last_command

    def _exchange(
        self, first_sample: int, command: F64, displacement_um: F64, measured: F64
    ) -> None:
        """Let a period pass for each command; samples skipped before it pass too, output held."""
        if self._plant is None:
            raise DeviceError("not open")
        if first_sample < self._next_sample:
            rule = f"first sample must be >= {self._next_sample}, which is next"
            raise DeviceError(f"{rule}, got {first_sample}")
        fault = self._fault
        if fault is not None:
            self._fail_exchange(fault, first_sample + command.size)
        if first_sample > self._next_sample:
            self._plant.hold(first_sample - self._next_sample, self._last_command)
        self._plant.step(command, displacement_um, measured)
        if fault is not None:
            self._spoil(fault, first_sample, displacement_um)
            self._last_reading_um = displacement_um.item(-1)
        self._next_sample = first_sample + command.size
        self._last_command = command.item(-1)

    def _put_out(self, command: float) -> None:
        """Put the output there; an injected fault does not prevent it."""
        self._last_command = command

    def _close(self) -> None:
        """There is nothing to disarm."""

    def _release(self) -> None:
        self._plant = None

    @abstractmethod
    def _build(self, sample_rate_hz: float) -> Plant:
        """Return a plant at rest."""

    def _check_sizes(self, command: F64, displacement_um: F64, measured: F64) -> None:
        """Take shorter blocks too: where a run's last one is cut, time goes on as it did."""
        sizes = {command.size, displacement_um.size, measured.size}
        if not self._block or len(sizes) > 1 or not 1 <= command.size <= self._block:
            super()._check_sizes(command, displacement_um, measured)

    def _fail_exchange(self, fault: SimulatedFault, end_sample: int) -> None:
        """Raise what an injected fault of the connection raises in a block that ends here."""
        if end_sample <= fault.at_sample:
            return
        if fault.kind == "no_answer":
            raise DeviceError("no answer in time (injected fault)")
        if fault.kind == "refused":
            raise DeviceError("the block was refused (injected fault)")

    def _spoil(self, fault: SimulatedFault, first_sample: int, displacement_um: F64) -> None:
        """Put an injected sensor fault on the readings it has reached."""
        if first_sample + displacement_um.size <= fault.at_sample:
            return
        start = max(0, fault.at_sample - first_sample)
        good = self._last_reading_um if start == 0 else displacement_um[start - 1]
        spoilt = displacement_um[start:]
        if fault.kind == "sensor_nan":
            spoilt[:] = np.nan
        elif fault.kind == "sensor_frozen":
            spoilt[:] = good
        elif fault.kind == "sensor_inverted":
            np.negative(spoilt, out=spoilt)
        elif fault.kind == "sensor_jump":
            spoilt += 0.5 * self._info.sensor_max_um
            np.minimum(spoilt, self._info.sensor_max_um, out=spoilt)
