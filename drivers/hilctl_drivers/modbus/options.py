"""Options of ``modbus_dac`` in an experiment."""

from typing import Literal, Self

from pydantic import Field, model_validator

from hilctl.base.device import DeviceOptions
from hilctl_drivers.device import HostWatchdog
from hilctl_drivers.wiring import Amplifier, Calibration, Sensor

_READERS = ("unit_id", "host", "tcp_port", "serial_port", "baud")


class ModbusOptions(DeviceOptions):
    """Options of ``modbus_dac``."""

    profile: str = Field(description="name of a shipped profile, or path of your own")
    host: str | None = Field(
        default=None, description="name or address, for Modbus TCP or a gateway to Modbus RTU"
    )
    port: int | None = Field(default=None, ge=1, le=65535, description="TCP port; else the usual")
    serial_port: str | None = Field(
        default=None, description="device file, for Modbus RTU; best under /dev/serial/by-id"
    )
    baud: int | None = Field(default=None, ge=300, description="else the profile's")
    parity: Literal["N", "E", "O"] | None = Field(default=None, description="else the profile's")
    stopbits: Literal[1, 2] | None = Field(default=None, description="else the profile's")
    unit_id: int | None = Field(default=None, ge=0, le=255, description="else the profile's")
    output: str = Field(description="output that drives the actuator")
    input: str = Field(description="input that the displacement sensor is wired to")
    reader: str | None = Field(
        default=None,
        description="profile of the device that has the input, where it is another one",
    )
    reader_unit_id: int | None = Field(
        default=None, ge=0, le=255, description="its unit id; else its profile's"
    )
    reader_host: str | None = Field(
        default=None, description="its name or address; left out where it is on the same connection"
    )
    reader_tcp_port: int | None = Field(
        default=None, ge=1, le=65535, description="its TCP port; else the usual"
    )
    reader_serial_port: str | None = Field(
        default=None, description="its device file; left out where it is on the same line"
    )
    reader_baud: int | None = Field(
        default=None, ge=300, description="of its own line; else its profile's"
    )
    timeout_s: float = Field(
        default=0.1, gt=0.0, le=60.0, description="longest wait for one answer, s"
    )
    amplifier: Amplifier | None = Field(
        default=None, description="left out only where the output is in A and drives the coil"
    )
    sensor: Sensor
    calibration: Calibration | None = None
    watchdog: HostWatchdog | Literal["none"] = Field(
        description="the device's own; none says that you know it would hold its last output"
    )

    @model_validator(mode="after")
    def _one_wire(self) -> Self:
        if (self.host is None) == (self.serial_port is None):
            raise ValueError("must have either host or serial_port")
        if self.host is None and self.port is not None:
            raise ValueError("port goes with host")
        return self

    @model_validator(mode="after")
    def _one_reader(self) -> Self:
        given = [name for name in _READERS if getattr(self, f"reader_{name}") is not None]
        if self.reader is None and given:
            raise ValueError(f"reader_{given[0]} goes with reader")
        if self.reader_host is not None and self.reader_serial_port is not None:
            raise ValueError("must have one of reader_host and reader_serial_port, or none")
        if self.reader_host is None and self.reader_tcp_port is not None:
            raise ValueError("reader_tcp_port goes with reader_host")
        if self.reader_serial_port is None and self.reader_baud is not None:
            raise ValueError("reader_baud goes with reader_serial_port")
        return self
