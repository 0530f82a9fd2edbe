"""What an experiment says of a device that streams over Modbus, held against its profile."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TypeAlias

from pydantic import Field

from hilctl.base.device import DeviceInfo
from hilctl.base.errors import DeviceError, InputError
from hilctl_drivers.labjack.profile import LabJackStreaming
from hilctl_drivers.labjack.stream import VALUES_MAX
from hilctl_drivers.modbus.options import ModbusOptions
from hilctl_drivers.modbus.profile import ModbusProfile
from hilctl_drivers.modbus.session import ModbusSession
from hilctl_drivers.modbus.setup import ModbusSetup
from hilctl_drivers.wire_time import WireTime

_NAME = "modbus_stream"

Connect: TypeAlias = Callable[[ModbusSetup], ModbusSession]
"""Makes a session on a new link."""


class ModbusStreamOptions(ModbusOptions):
    """Options of ``modbus_stream``."""

    fifo_blocks: int = Field(
        default=8,
        ge=1,
        le=1024,
        description="blocks kept in the device's buffer: what a stall of this machine may last,"
        " and by how much displacements come later",
    )


def stream_time(profile: ModbusProfile, block: int) -> WireTime:
    """Return what a block costs: messages that bring its values, and one that waits for the clock.

    Readings come back in the same messages, so that fetching the last of them is one more.
    """
    messages = math.ceil(block / VALUES_MAX) + 1
    what = f"{block} samples in {messages} messages over TCP"
    return WireTime(what, 0.0, 0.0, 0, 0.0, messages * profile.turnaround_s, block)


@dataclass(frozen=True, slots=True)
class StreamSetup:
    """What an experiment's options come to.

    Attributes:
        base: What they say of the device, streaming or not.
        streaming: What its profile says of streaming.
        fifo_blocks: Blocks kept in its buffer.
        channel: Number of the input, for its calibration.
    """

    base: ModbusSetup
    streaming: LabJackStreaming
    fifo_blocks: int
    channel: int

    @classmethod
    def of(cls, options: ModbusStreamOptions) -> "StreamSetup":
        """Load the profile and hold the options against it.

        Raises:
            InputError: They don't go together, or the device can't stream.
        """
        base = ModbusSetup.of(options)
        profile = base.profile
        streaming = profile.streaming
        if streaming == "none":
            raise InputError(f"{profile.title} can't stream: take kind: modbus_dac, and block: 1")
        if base.reads_elsewhere:
            raise InputError("reader must be left out: input and output are in one scan list")
        for what, name, known in (
            ("output", options.output, streaming.outputs),
            ("input", options.input, streaming.inputs),
        ):
            if name not in known:
                rule = f"{what} must be one that {profile.title} can stream, {', '.join(known)}"
                raise InputError(f"{rule}, got {name!r}")
        return cls(base, streaming, options.fifo_blocks, base.input_address() // 2)

    @property
    def title(self) -> str:
        """The device in messages: its profile and where it is."""
        return f"{_NAME} {self.base.writer.name} at {self.base.writer.place}"

    @property
    def block_max(self) -> int:
        """Longest block of which one more than ``fifo_blocks`` fit into the buffer."""
        return max(1, self.streaming.fifo_depth // (self.fifo_blocks + 1))

    def rate(self, block: int) -> tuple[float, str]:
        """Return the highest sample rate with that block, in Hz, and why it is that."""
        wire = stream_time(self.base.profile, block)
        most_hz = self.streaming.rate_max_hz
        if wire.highest_rate_hz <= most_hz:
            return wire.highest_rate_hz, str(wire)
        per_s = self.streaming.samples_per_s_max
        return most_hz, f"{per_s:g} samples a second for an input and an output; {wire}"

    def check_rate(self, rate_hz: float, block: int, capacity: int) -> None:
        """Refuse what the device's clock or buffer can't do.

        Args:
            rate_hz: Sample rate.
            block: Samples in an exchange.
            capacity: Samples that the buffer holds.

        Raises:
            DeviceError: What can't be, and what would be possible.
        """
        need = (self.fifo_blocks + 1) * block
        if block < 1 or need > capacity:
            most = max(1, capacity // (self.fifo_blocks + 1))
            rule = f"block must be 1 to {most}: fifo_blocks + 1 of them must fit into the FIFO"
            raise DeviceError(f"{rule}, {capacity} samples, got {block}")
        highest_hz, note = self.rate(block)
        lowest_hz = self.streaming.rate_min_hz
        if not lowest_hz <= rate_hz <= highest_hz:
            span = f"[{lowest_hz:g}, {highest_hz:.6g}] Hz with blocks of {block}"
            raise DeviceError(f"sample rate must be in {span} ({note}), got {rate_hz:g}")

    def info(self) -> DeviceInfo:
        """Return what the device is and what it accepts."""
        found = self.base.info()
        highest_hz, note = self.rate(self.block_max)
        depth = self.streaming.fifo_depth
        details = {
            **found.details,
            "fifo_depth": f"{depth} samples",
            "fifo_level": f"{self.fifo_blocks} blocks",
        }
        return replace(
            found,
            name=_NAME,
            max_rate_hz=highest_hz,
            rate_note=note,
            buffered=True,
            fifo_depth=depth,
            latency_blocks=self.fifo_blocks,
            details=details,
        )
