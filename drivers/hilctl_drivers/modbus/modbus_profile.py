"""Profiles of Modbus devices (TCP and RTU), including streaming."""

from collections.abc import Iterator, Mapping
from itertools import combinations
from typing import Annotated, ClassVar, Literal, Self

from pydantic import Field, model_validator

from hilctl.base.strict import StrictModel
from hilctl_drivers.modbus.register_map import (
    AddressBase,
    Channel,
    DigitalRegister,
    ModbusSelftest,
    ModbusStep,
    Register,
    RegisterStep,
    StatusRegister,
    Validity,
    address_span,
    wire_address,
)
from hilctl_drivers.profile_base import (
    BaseProfile,
    BinaryLineSettings,
    LinkSettings,
    Name,
    SteppedWatchdog,
    StreamSettings,
    parts_of,
)

BYTES_A_SAMPLE = 2
"""A T-series device stores a sample in either buffer as 16 bits."""


class LabJackStreaming(StrictModel):
    """Stream-out and stream-in of LabJack T-series devices, in one scan list."""

    kind: Literal["labjack"]
    outputs: tuple[Name, ...] = Field(min_length=1, description="outputs that can stream")
    inputs: tuple[Name, ...] = Field(min_length=1, description="inputs that can stream")
    buffer_bytes: int = Field(
        ge=32, le=32_768, description="size of the output buffer (2 bytes per sample); a power of 2"
    )
    samples_per_s_max: float = Field(
        gt=0.0, description="highest sampling rate, for all addresses of the scan list together"
    )
    rate_min_hz: float = Field(gt=0.0, description="lowest scan rate, Hz")
    calibration: Literal["two_slopes", "line"] = Field(
        description="conversion of raw readings to volts: two_slopes (one on each side of a centre,"
        " for all inputs) or line (slope and offset per input)"
    )
    calibration_address: int = Field(ge=0, description="flash address of these constants")
    setup: tuple[ModbusStep, ...] = Field(
        default=(), description="steps before streaming is set up"
    )

    @model_validator(mode="after")
    def _whole_power(self) -> Self:
        if self.buffer_bytes & (self.buffer_bytes - 1):
            raise ValueError(f"buffer_bytes must be a power of 2, got {self.buffer_bytes}")
        return self

    @property
    def fifo_depth(self) -> int:
        """Samples that the output's buffer holds."""
        return self.buffer_bytes // BYTES_A_SAMPLE

    def rate_max_hz(self, inputs: int, outputs: int = 1) -> float:
        """Return the highest scan rate with some inputs and outputs in the scan list, Hz."""
        return self.samples_per_s_max / (outputs + inputs)


GAP_CHARS = 3.5
FAST_BAUD = 19200
FAST_GAP_S = 1.75e-3
"""Silence between RTU frames above 19200 baud (Modbus over serial line 1.02, section 2.5.1.1)."""


MODBUS_PORT = 502
"""TCP port registered for Modbus."""


class ModbusTcpLink(LinkSettings):
    """Modbus TCP."""

    kind: Literal["tcp"]
    port: int = Field(default=MODBUS_PORT, ge=1, le=65535, description="TCP port")


class ModbusRtuTcpLink(StreamSettings):
    """Frames of Modbus RTU on a TCP connection."""

    kind: Literal["rtu_tcp"]
    port: int = Field(default=MODBUS_PORT, ge=1, le=65535, description="TCP port")


class ModbusRtuLink(BinaryLineSettings):
    """Modbus RTU."""

    port: ClassVar[int] = MODBUS_PORT  # of a gateway or a serial server

    kind: Literal["rtu"]
    gap_s: float | None = Field(
        default=None,
        ge=0.0,
        description="silence before each frame, s; default: 3.5 characters, 1.75 ms above 19200",
    )

    @property
    def silence_s(self) -> float:
        """Silence before each frame, s."""
        if self.gap_s is not None:
            return self.gap_s
        return FAST_GAP_S if self.baud > FAST_BAUD else GAP_CHARS * self.char_s


class ModbusOutput(Channel):
    """An analogue output."""

    function: Literal[6, 16] = Field(default=16, description="Modbus function of a write")
    readback: Register | Literal["same", "none"] = Field(
        default="same",
        description="register to read the value back: another one, same, or none if it cannot be"
        " read; scale and offset are the output's",
    )
    power_up: float | None = Field(
        default=None, description="output after power-up, in unit; omitted if unknown"
    )

    @model_validator(mode="after")
    def _writable(self) -> Self:
        if self.area != "holding":
            raise ValueError(f"area of an output must be holding, got {self.area}")
        if self.power_up is not None and not self.min <= self.power_up <= self.max:
            raise ValueError(f"power_up must be min to max, got {self.power_up:g}")
        if self.function == 6 and self.words != 1:
            raise ValueError(f"function 6 writes one register, {self.type} takes {self.words}")
        return self

    @property
    def readback_register(self) -> Register | None:
        """Register to read back the value with the output's scale; None if there is none."""
        if self.readback == "none":
            return None
        if self.readback == "same":
            return self
        return self.readback.model_copy(update={"scale": self.scale, "offset": self.offset})


class ModbusInput(Channel):
    """An analogue input."""

    measures: Literal["terminal", "output"] = Field(
        default="terminal",
        description="measured quantity: the signal at the terminal, or the device's own output",
    )
    validity: Validity | Literal["none"] = Field(
        default="none",
        description="register that shows whether the reading is valid; an invalid reading is"
        " recorded as missing. It is read with the input if it is beside it or part of it",
    )

    @model_validator(mode="after")
    def _readable(self) -> Self:
        if self.area not in {"holding", "input"}:
            raise ValueError(f"area of an input must be holding or input, got {self.area}")
        return self


class ModbusWatchdog(SteppedWatchdog[ModbusStep]):
    """A host watchdog set and read through registers."""

    unlock: tuple[ModbusStep, ...] = Field(
        default=(),
        description="steps before safe and arm, run only if an ensure step in those has a register"
        " to change",
    )
    tripped: StatusRegister | Literal["none"] = Field(
        default="none", description="register that shows a trip"
    )

    def bound(
        self, steps: tuple[ModbusStep, ...], output: ModbusOutput, timeout_s: float, safe: float
    ) -> tuple[ModbusStep, ...]:
        """Return steps with numbers for ``timeout`` and ``safe``, scaled to the device's units.

        ``safe`` is in the unit of the output in use.
        """
        self.counts(timeout_s)
        changes: dict[str, dict[str, float]] = {
            "timeout": {"value": timeout_s, "scale": self.unit_s, "offset": 0.0},
            "safe": {"value": safe, "scale": output.scale, "offset": output.offset},
        }
        return tuple(
            step.model_copy(update=changes[step.value])
            if isinstance(step, RegisterStep) and isinstance(step.value, str)
            else step
            for step in steps
        )


class ModbusProfile(BaseProfile):
    """A Modbus device."""

    DEVICE: ClassVar[str] = "modbus_dac"
    WIRES: ClassVar[Mapping[str, str]] = {
        "modbus_dac": "hilctl_drivers.modbus.register_wire:RegisterWire",
        "modbus_stream": "hilctl_drivers.labjack.labjack_wire:LabJackWire",
    }
    SESSION: ClassVar[str] = "hilctl_drivers.modbus.modbus_session:ModbusSession"

    link: Annotated[
        ModbusTcpLink | ModbusRtuTcpLink | ModbusRtuLink, Field(discriminator="kind")
    ] = Field(description="connection to the device")
    unit_id: int = Field(default=1, ge=0, le=255, description="unit id as shipped")
    address_base: AddressBase = Field(description="address_base of registers without their own")
    exchange: Literal[23, 76, "none"] = Field(
        description="function that writes the output and reads the input in one transaction"
    )
    outputs: dict[Name, ModbusOutput] = Field(description="analogue outputs by name")
    inputs: dict[Name, ModbusInput] = Field(description="analogue inputs by name")
    digital_outputs: dict[Name, DigitalRegister] = Field(
        default={}, description="digital outputs by name, for pulses at marks of the waveform"
    )
    digital_inputs: dict[Name, DigitalRegister] = Field(
        default={}, description="digital inputs by name, for the start of a run"
    )
    init: tuple[ModbusStep, ...] = Field(default=(), description="steps after connecting")
    close: tuple[ModbusStep, ...] = Field(default=(), description="steps before disconnecting")
    watchdog: ModbusWatchdog | Literal["none"] = Field(description="the device's own, or none")
    selftest: ModbusSelftest | Literal["none"] = Field(
        default="none", description="register that identifies the device"
    )
    error_register: StatusRegister | Literal["none"] = Field(
        default="none",
        description="register that is not 0 if the device has refused a value; read after each"
        " write of a run, which ends with an error",
    )
    streaming: LabJackStreaming | Literal["none"] = Field(
        default="none", description="streaming that the device supports"
    )

    @model_validator(mode="after")
    def _channels(self) -> Self:
        if self.exchange != "none" and not (self.outputs and self.inputs):
            raise ValueError("exchange must be none if there are no outputs or no inputs")
        checked = [self.error_register, *(each.validity for each in self.inputs.values())]
        if self.streaming != "none" and any(each != "none" for each in checked):
            raise ValueError("streaming must be none with validity or error_register")
        for key in ("outputs", "inputs") if self.streaming != "none" else ():
            unknown = [
                name for name in getattr(self.streaming, key) if name not in getattr(self, key)
            ]
            if unknown:
                raise ValueError(f"streaming.{key} must be {key} of the profile, got {unknown[0]}")
        return self

    @model_validator(mode="after")
    def _addresses(self) -> Self:
        for where, register in self.registers():
            address = self.wire_address(register)
            if not 0 <= address <= 65_536 - register.words:
                base = self.address_base if register.address_base is None else register.address_base
                raise ValueError(
                    f"{where}.address must be {address_span(register, base)} in area"
                    f" {register.area} with address_base {base}, got {register.address}"
                )
        channels = (*self.outputs.items(), *self.inputs.items())
        for (name, one), (other, two) in combinations(channels, 2):
            at, behind = self.wire_address(one), self.wire_address(two)
            alike = (at, one.words) == (behind, two.words)
            overlap = at < behind + two.words and behind < at + one.words
            if one.area == two.area and overlap and not alike:
                raise ValueError(f"the registers of {name} and {other} overlap: {at} and {behind}")
        for name, output in self.digital_outputs.items():
            if output.area not in {"coil", "holding"}:
                raise ValueError(
                    f"digital_outputs.{name}.area must be coil or holding, got {output.area}"
                )
        for name, channel in self.inputs.items():
            if self.exchange == 23 and channel.area != "holding":
                raise ValueError(f"inputs.{name}.area must be holding: exchange 23 reads holding")
        return self

    @model_validator(mode="after")
    def _placeholders(self) -> Self:
        for name in ("init", "close"):
            values = [getattr(step, "value", 0.0) for step in getattr(self, name)]
            if {"timeout", "safe"} & set(values):
                raise ValueError(f"{name}: timeout and safe are for watchdog steps")
        if self.watchdog != "none":
            unknown = set(self.watchdog.safe) - set(self.outputs)
            if unknown:
                raise ValueError(f"watchdog.safe.{min(unknown)} must be one of the outputs")
        return self

    @property
    def usual_unit(self) -> int:
        """See :attr:`~hilctl_drivers.profile_base.BaseProfile.usual_unit`."""
        return self.unit_id

    @property
    def framings(self) -> tuple[Literal["tcp", "rtu"], ...]:
        """See :attr:`~hilctl_drivers.profile_base.BaseProfile.framings`."""
        if self.link.kind == "rtu":  # behind a gateway, or a serial server that passes bytes on
            return "tcp", "rtu"
        return ("tcp",) if self.link.kind == "tcp" else ("rtu",)

    def registers(self) -> Iterator[tuple[str, Register]]:
        """Yield every register with its dotted key."""
        return ((key, each) for key, each in parts_of(self) if isinstance(each, Register))

    def wire_address(self, register: Register) -> int:
        """Return the address that goes into the frame, 0 to 65535."""
        base = self.address_base if register.address_base is None else register.address_base
        return wire_address(register, base)
