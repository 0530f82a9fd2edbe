"""A piezo stage written for hilctl 0.2.0, as its documentation describes a device.

Never edit this file: a later version of hilctl that cannot run it breaks the packages of its users.
"""

from typing import ClassVar

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from hilctl.base import Device, DeviceError, DeviceInfo, DeviceOptions, UnconfirmedError

F64 = NDArray[np.float64]


class StageOptions(DeviceOptions):
    """Keys beside ``kind`` in the experiment file."""

    um_per_v: float = Field(default=0.4, gt=0.0, description="displacement of one volt, um")
    voltage_max_v: float = Field(default=100.0, gt=0.0, description="largest voltage, V")
    watchdog_s: float | None = Field(default=None, gt=0.0, description="timeout of the watchdog, s")
    confirms: bool = Field(default=True, description="whether a write of the output is answered")


class Stage(Device):
    """A displacement that follows the voltage one sample later."""

    Options: ClassVar[type[DeviceOptions]] = StageOptions

    def __init__(self, options: StageOptions) -> None:
        self._options = options
        self._voltage_v = 0.0
        self._block = 0
        self._armed = False
        self._info = DeviceInfo(
            name="frozen_stage",
            description=f"stage of {options.um_per_v:g} um/V",
            command_unit="V",
            command_min=0.0,
            command_max=options.voltage_max_v,
            sensor_min_um=-1.0,
            sensor_max_um=options.um_per_v * options.voltage_max_v + 1.0,
            max_rate_hz=20_000.0,
            rate_note="its conversion takes 50 us",
            measures_command=True,
            confirms=options.confirms,
            simulated=True,
            watchdog_command=None if options.watchdog_s is None else 0.0,
            watchdog_timeout_s=options.watchdog_s,
            details={"serial_number": "17"},
        )

    @property
    def info(self) -> DeviceInfo:
        return self._info

    def check_rate(self, sample_rate_hz: float, block: int) -> None:
        if not 0.0 < sample_rate_hz <= self._info.max_rate_hz:
            raise DeviceError(f"frozen_stage: cannot keep {sample_rate_hz:g} Hz")

    def open(self, sample_rate_hz: float, block: int) -> None:
        self.check_rate(sample_rate_hz, block)
        self._block = block

    def arm(self) -> None:
        self._need_open()
        self._armed = self._options.watchdog_s is not None

    def output(self) -> float:
        self._need_open()
        return self._voltage_v

    def look(self) -> tuple[float, float | None]:
        return self._options.um_per_v * self._voltage_v, self._voltage_v

    def exchange(
        self, first_sample: int, command: F64, displacement_um: F64, measured: F64
    ) -> None:
        self._need_open()
        if command.size != self._block:
            raise DeviceError(f"frozen_stage: sample {first_sample} needs a block of {self._block}")
        self._need_range(command)
        before = np.concatenate(([self._voltage_v], command[:-1]))
        displacement_um[:] = self._options.um_per_v * before
        measured[:] = command
        self._voltage_v = float(command[-1])

    def make_safe(self, command: float) -> None:
        self._need_range(np.array([command]))
        self._voltage_v = command
        if not self._options.confirms:
            raise UnconfirmedError("frozen_stage: no answer confirms the output")

    def close(self) -> None:
        self._block, self._armed = 0, False

    def _need_open(self) -> None:
        if not self._block:
            raise DeviceError("frozen_stage: is not open")

    def _need_range(self, command: F64) -> None:
        if not ((command >= 0.0) & (command <= self._options.voltage_max_v)).all():
            raise DeviceError(f"frozen_stage: a command of {command} is out of range")
