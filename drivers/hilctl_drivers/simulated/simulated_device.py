"""A simulated actuator as a device, and several of them with crosstalk as a joint device.

Time passes only in an exchange, one sample period per command, so a run needs no real time. Seen
from the run this is a device with its own sample clock and FIFO, so it is described as buffered.
"""

from abc import abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any, ClassVar, Literal

import numpy as np

from hilctl.base.device import (
    Device,
    DeviceInfo,
    DeviceOptions,
    JointDevice,
)
from hilctl.base.errors import DeviceError, InputError
from hilctl.base.strict import Field, StrictModel
from hilctl.base.types import F64
from hilctl_drivers.device import CalibrationName, DacDevice, details_of
from hilctl_drivers.simulated.actuator_base import Plant
from hilctl_drivers.simulated.crosstalk import CoupledPlants, Crosstalk
from hilctl_drivers.simulated.piezo import PiezoParameters
from hilctl_drivers.simulated.terfenol import (
    TerfenolParameters,
)

FIFO_DEPTH = 4096
MAX_RATE_HZ = 200e3
_SETTLING_S = 0.1
_S_SHAPE = 1.5 * 3.0**0.5  # 1 / largest value of x - x^3
_LOST = {
    "no_answer": "no answer in time (injected fault)",
    "refused": "the block was refused (injected fault)",
}


class SimulatedFault(StrictModel):
    """A fault to inject, permanent from its sample on, to test the reaction of a run."""

    kind: Literal[
        "sensor_nan",
        "sensor_frozen",
        "sensor_jump",
        "sensor_inverted",
        "aux_nan",
        "no_answer",
        "refused",
    ] = Field(
        description="sensor_nan: readings are not numbers; sensor_frozen: the last good reading"
        " is repeated; sensor_jump: readings are off by half the sensor's range; sensor_inverted:"
        " readings have the other sign; aux_nan: auxiliary channels are not numbers; no_answer:"
        " exchanges time out; refused: exchanges are refused"
    )
    at_sample: int = Field(ge=0, description="first sample that has the fault")


class SimulatedOptions(DeviceOptions):
    """Options of every simulated device."""

    REMOVED: ClassVar[Mapping[str, str]] = {"physics": "removed, there is one; delete the key"}

    seed: int = Field(default=1, ge=0, description="seed of the sensor noise")
    noise: bool = Field(default=True, description="whether the sensor has noise")
    nonlinearity_percent: float = Field(
        default=0.0,
        ge=-5.0,
        le=5.0,
        description="largest error of the sensor, S-shaped, in percent of its range",
    )
    calibration: CalibrationName | None = Field(
        default=None, description="calibration file of the sensor to apply"
    )
    fault: SimulatedFault | None = Field(default=None, description="fault to inject")
    crosstalk: dict[str, Crosstalk] = Field(
        default_factory=dict,
        description="crosstalk of other axes into the sensor, by the name of the axis that moves",
    )
    output_at_open: float | None = Field(
        default=0.0,
        description="output when the device is opened, in its unit; null for 0 and a device that"
        " does not report it",
    )


class SimulatedDevice(DacDevice):
    """A :class:`~hilctl.base.device.Device` around a plant; opening it puts the plant at rest."""

    Options: ClassVar[type[DeviceOptions]] = SimulatedOptions
    block_max = FIFO_DEPTH

    def __init__(
        self,
        options: SimulatedOptions,
        parameters: TerfenolParameters | PiezoParameters,
        **info: Any,
    ) -> None:
        """Describe the device; a recording keeps parameters and options as its details."""
        calibration = options.calibration
        if calibration is not None and calibration.content.amplifier is not None:
            raise InputError("calibration: a simulated device has no amplifier: remove amplifier")
        plain = asdict(parameters)
        details = plain | plain.pop("rods", {}) | options.model_dump(mode="json")
        described = DeviceInfo(
            sensor_min_um=-parameters.sensor_range_um,
            sensor_max_um=parameters.sensor_range_um,
            max_rate_hz=MAX_RATE_HZ,
            buffered=True,
            fifo_depth=FIFO_DEPTH,
            measures_command=True,
            simulated=True,
            details=details_of(details),
            calibration=calibration,
            digital_output="DO",
            digital_input="DI",
            **info,
        )
        super().__init__(described, described.name, "exchange a block", "the output")
        self._fault = options.fault
        self.crosstalk = options.crosstalk
        self._reach_um = parameters.sensor_range_um
        self._bend = _S_SHAPE * 2.0 * self._reach_um * 0.01 * options.nonlinearity_percent
        self._output_at_open = options.output_at_open
        self._plant: Plant | None = None
        self._next_sample = self._digital_readings = 0
        self.last_command = 0.0
        """The output, in its unit."""
        self._rate_hz = self._last_reading_um = 0.0

    def _open(self, sample_rate_hz: float, block: int) -> None:
        """Put the plant at rest at the present output, with the sample count at 0."""
        self._rate_hz, self._digital_readings = sample_rate_hz, 0
        self._plant = self.plant(sample_rate_hz)
        self._next_sample = 0
        self.last_command = self._output_at_open or 0.0
        self._last_reading_um = 0.0
        if self.last_command:
            self._plant.hold(round(_SETTLING_S * sample_rate_hz), self.last_command)

    @property
    def opened_plant(self) -> Plant:
        """The plant of the open device."""
        assert self._plant is not None
        return self._plant

    def _output(self) -> float | None:
        return None if self._output_at_open is None else self.last_command

    def _exchange(
        self, first_sample: int, command: F64, displacement_um: F64, measured: F64
    ) -> None:
        """Let a period pass for each command; samples skipped before it pass too, output held."""
        if skipped := self._skipped_before(first_sample, command.size):
            self.opened_plant.hold(skipped, self.last_command)
        self.opened_plant.step(command, displacement_um, measured)
        self._follow(first_sample, command, displacement_um, measured)

    def begin_block(
        self, first_sample: int, command: F64, displacement_um: F64, measured: F64
    ) -> int:
        """Check a block of a joint exchange as :meth:`exchange` does; return the skipped samples.

        The caller advances the plant, then calls :meth:`end_block`.
        """
        self.check_blocks(command, displacement_um, measured)
        try:
            return self._skipped_before(first_sample, command.size)
        except DeviceError as error:
            raise self._failed(self._action, error, self._abandon) from None

    def end_block(
        self, first_sample: int, command: F64, displacement_um: F64, measured: F64
    ) -> None:
        """Finish a block whose readings are filled."""
        self._follow(first_sample, command, displacement_um, measured)
        self._correct(displacement_um)

    def _skipped_before(self, first_sample: int, samples: int) -> int:
        """Return the samples that were skipped before a block.

        Raise DeviceError if it does not follow, or its exchange has an injected fault.
        """
        if first_sample < self._next_sample:
            rule = f"first sample must be >= {self._next_sample}, which is next"
            raise DeviceError(f"{rule}, got {first_sample}")
        fault = self._fault
        if fault is not None and fault.kind in _LOST and first_sample + samples > fault.at_sample:
            raise DeviceError(_LOST[fault.kind])
        return first_sample - self._next_sample

    def _follow(self, first_sample: int, command: F64, displacement_um: F64, measured: F64) -> None:
        """Distort the readings of a block, and keep what the next one needs."""
        if self._bend:
            share = displacement_um / self._reach_um
            displacement_um += self._bend * (share - share**3)
        if (fault := self._fault) is not None:
            self._spoil(fault, first_sample, displacement_um)
            self._last_reading_um = displacement_um.item(-1)
        self._next_sample = first_sample + command.size
        self.last_command = command.item(-1)

    def join(self, devices: Mapping[str, Device]) -> JointDevice | None:
        """Return all simulated devices as one if the sensor of any sees another axis."""
        simulated = {
            name: each for name, each in devices.items() if isinstance(each, SimulatedDevice)
        }
        seen = any(each.crosstalk for each in simulated.values())
        return JointSimulated(simulated) if seen else None

    def _put_out(self, command: float) -> None:
        """Set the output; an injected fault does not prevent it."""
        self.last_command = command

    def _set_digital(self, high: bool) -> None:
        """Do nothing: a recording has the pulses."""

    def _read_digital(self) -> bool:
        """Return whether a second has passed; a period passes per reading."""
        self._digital_readings += 1
        return self._digital_readings > self._rate_hz

    def _close(self) -> None:
        """Do nothing: there is nothing to disarm."""

    def _release(self) -> None:
        self._plant = None

    @abstractmethod
    def plant(self, sample_rate_hz: float) -> Plant:
        """Return a plant at rest."""

    def _check_sizes(self, command: F64, displacement_um: F64, measured: F64) -> None:
        """Accept shorter blocks too: the last one of a run may be cut."""
        sizes = {command.size, displacement_um.size, measured.size}
        if not self._block or len(sizes) > 1 or not 1 <= command.size <= self._block:
            super()._check_sizes(command, displacement_um, measured)

    def _spoil(self, fault: SimulatedFault, first_sample: int, displacement_um: F64) -> None:
        """Apply an injected sensor fault to the readings from its sample on."""
        if first_sample + displacement_um.size <= fault.at_sample:
            return
        start = max(0, fault.at_sample - first_sample)
        good = self._last_reading_um if start == 0 else displacement_um[start - 1]
        spoilt = displacement_um[start:]
        if fault.kind == "sensor_nan":
            spoilt[:] = np.nan
        elif fault.kind == "aux_nan":
            self.aux[:] = np.nan
        elif fault.kind == "sensor_frozen":
            spoilt[:] = good
        elif fault.kind == "sensor_inverted":
            np.negative(spoilt, out=spoilt)
        elif fault.kind == "sensor_jump":
            spoilt += 0.5 * self._reach_um
            np.minimum(spoilt, self._reach_um, out=spoilt)


class JointSimulated:
    """Simulated devices whose sensors see each other; see :class:`hilctl.base.device.JointDevice`.

    Args:
        devices: Devices by name of their axes.
    """

    max_rate_hz, rate_note = MAX_RATE_HZ, ""

    def __init__(self, devices: Mapping[str, SimulatedDevice]) -> None:
        self.axes: Sequence[str] = [*devices]
        self._devices = [*devices.values()]
        self._crosstalk = {axis: device.crosstalk for axis, device in devices.items()}
        self._plants: CoupledPlants | None = None

    def check_rate(self, sample_rate_hz: float, block: int) -> None:
        """Reject a rate that a device cannot keep."""
        for device in self._devices:
            device.check_rate(sample_rate_hz, block)

    def open(self, sample_rate_hz: float, block: int) -> None:
        """Put the plants at rest at their present outputs."""
        try:
            for device in self._devices:
                device.open(sample_rate_hz, block)
        except DeviceError:
            self.close()
            raise
        plants = [device.opened_plant for device in self._devices]
        self._plants = self.coupled(dict(zip(self.axes, plants, strict=True)), sample_rate_hz)
        if any(outputs := [device.last_command for device in self._devices]):
            self._plants.hold(round(_SETTLING_S * sample_rate_hz), outputs)

    def coupled(self, plants: Mapping[str, Plant], sample_rate_hz: float) -> CoupledPlants:
        """Return the opened plants of the axes with their crosstalk."""
        return CoupledPlants(plants, self._crosstalk, sample_rate_hz)

    def exchange(
        self,
        first_sample: int,
        commands: Sequence[F64],
        displacements_um: Sequence[F64],
        measured: Sequence[F64],
    ) -> None:
        """Let a period pass for each sample of the blocks, float64[block] per axis."""
        assert self._plants is not None
        blocks = [*zip(self._devices, commands, displacements_um, measured, strict=True)]
        outputs = [device.last_command for device in self._devices]
        skipped = [device.begin_block(first_sample, *block) for device, *block in blocks]
        if skipped[0]:
            self._plants.hold(skipped[0], outputs)
        self._plants.step(commands, displacements_um, measured)
        for device, *block in blocks:
            device.end_block(first_sample, *block)

    def close(self) -> None:
        """Close all devices; the outputs stay."""
        for device in self._devices:
            device.close()
