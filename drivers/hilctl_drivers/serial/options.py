"""Options of ``serial_dac`` in an experiment."""

from typing import Literal

from pydantic import Field

from hilctl.base.device import DeviceOptions
from hilctl_drivers.device import HostWatchdog
from hilctl_drivers.wiring import Amplifier, Calibration, Sensor


class SerialOptions(DeviceOptions):
    """Options of ``serial_dac``."""

    profile: str = Field(description="name of a shipped profile, or path of your own")
    serial_port: str = Field(description="device file; best under /dev/serial/by-id")
    baud: int | None = Field(default=None, ge=300, description="else the profile's")
    parity: Literal["N", "E", "O"] | None = Field(default=None, description="else the profile's")
    stopbits: Literal[1, 2] | None = Field(default=None, description="else the profile's")
    address: int | None = Field(
        default=None, ge=0, le=255, description="on a shared line; else the profile's"
    )
    output: str = Field(description="output that drives the actuator")
    input: str = Field(description="input that the displacement sensor is wired to")
    reader: str | None = Field(
        default=None,
        description="profile of the device that has the input, where it is another one",
    )
    reader_port: str | None = Field(
        default=None, description="its device file; left out where it is on the same line"
    )
    reader_address: int | None = Field(
        default=None, ge=0, le=255, description="its address on a shared line; else the profile's"
    )
    measure: str | None = Field(
        default=None,
        description="input that measures the output itself, recorded beside the command; it costs"
        " one more question a sample",
    )
    timeout_s: float = Field(
        default=0.1, gt=0.0, le=60.0, description="longest wait for one answer, s"
    )
    fifo_blocks: int = Field(
        default=8,
        ge=1,
        le=1024,
        description="blocks kept in the FIFO of a streaming board: what a stall of this machine"
        " may last, and by how much displacements come later",
    )
    amplifier: Amplifier | None = Field(
        default=None, description="left out only where the output is in A and drives the coil"
    )
    sensor: Sensor
    calibration: Calibration | None = None
    watchdog: HostWatchdog | Literal["none"] = Field(
        description="the device's own; none says that you know it would hold its last output"
    )
