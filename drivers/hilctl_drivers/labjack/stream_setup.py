"""What an experiment says of a device that streams over Modbus, held against its profile."""

import math
from dataclasses import dataclass, replace

from hilctl.base.device import DeviceInfo
from hilctl.base.errors import DeviceError, InputError
from hilctl_drivers.labjack.labjack_profile import LabJackStreaming
from hilctl_drivers.labjack.stream import VALUES_MAX
from hilctl_drivers.modbus.config import ModbusOptions, ModbusSetup
from hilctl_drivers.modbus.modbus_profile import ModbusProfile
from hilctl_drivers.signal_chain import FifoBlocks
from hilctl_drivers.transport.wire_time import RateLimit, WireTime


def stream_time(profile: ModbusProfile, block: int) -> WireTime:
    """Return what a block costs: messages that bring its values, and one that waits for the clock.

    Readings come back in the same messages, so that fetching the last of them is one more.
    """
    messages = math.ceil(block / VALUES_MAX) + 1
    what = f"{block} samples in {messages} messages over TCP"
    return WireTime(what, 0.0, 0.0, 0, 0.0, messages * profile.turnaround_s, block)


class ModbusStreamOptions(ModbusOptions):
    """Options of ``modbus_stream``."""

    fifo_blocks: FifoBlocks = 8


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
        """Hold options against their profile.

        Raises:
            InputError: They don't go together, or the device can't stream.
        """
        base = ModbusSetup.of(options)
        profile = base.writer.profile
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
        return cls(base, streaming, options.fifo_blocks, base.writer.address(base.input) // 2)

    @property
    def block_max(self) -> int:
        """Longest block of which one more than ``fifo_blocks`` fit into the buffer."""
        return max(1, self.streaming.fifo_depth // (self.fifo_blocks + 1))

    def rates(self, block: int) -> RateLimit:
        """Return the sample rates that it can keep with that block."""
        per_s, settle_s = self.streaming.samples_per_s_max, self.base.output.settle_s
        most_hz, whose = self.streaming.rate_max_hz, f"{per_s:g} samples a second for an input and"
        whose += " an output: its profile"
        if settle_s * most_hz > 1.0:
            most_hz, whose = 1.0 / settle_s, f"settling {settle_s * 1e3:.2f} ms: its profile"
        wire = stream_time(self.base.writer.profile, block)
        return RateLimit.of(wire, most_hz, whose, self.streaming.rate_min_hz)

    def check_capacity(self, block: int, capacity: int) -> None:
        """Refuse a block that the buffer is too small for.

        Args:
            block: Samples in an exchange.
            capacity: Samples that the buffer holds.

        Raises:
            DeviceError: What can't be, and what would be possible.
        """
        if (self.fifo_blocks + 1) * block > capacity:
            most = max(1, capacity // (self.fifo_blocks + 1))
            rule = f"block must be 1 to {most}: fifo_blocks + 1 of them must fit into the FIFO"
            raise DeviceError(f"{rule}, {capacity} samples, got {block}")

    def info(self) -> DeviceInfo:
        """Return what the device is and what it accepts."""
        found = self.base.info()
        rates = self.rates(self.block_max)
        depth = self.streaming.fifo_depth
        details = {
            **found.details,
            "fifo_depth": f"{depth} samples",
            "fifo_level": f"{self.fifo_blocks} blocks",
        }
        return replace(
            found,
            name="modbus_stream",
            max_rate_hz=rates.highest_hz,
            rate_note=rates.note,
            buffered=True,
            fifo_depth=depth,
            latency_blocks=self.fifo_blocks,
            details=details,
        )
