"""Test doubles that several tests share.

A link to an emulated Modbus device in the same process, in a time that the caller makes pass:
nothing waits for anything, a second of streaming takes as long as its samples take to work out.
"""

from dataclasses import dataclass
from pathlib import Path

from hilctl.base.errors import InputError
from hilctl_drivers.emulator.labjack_stream import attach_stream
from hilctl_drivers.emulator.modbus_device import EmulatedModbus
from hilctl_drivers.emulator.modbus_wire import ModbusWire
from hilctl_drivers.emulator.rig import Rig, WriteLog
from hilctl_drivers.modbus.profile import ModbusProfile
from hilctl_drivers.profile import load_profile
from hilctl_drivers.wire.links import LostError, Missing, NoAnswerError


@dataclass(slots=True)
class VirtualTime:
    """Time that passes when told to, and by each message.

    Attributes:
        now_ns: The time.
    """

    now_ns: int = 1_000_000_000

    def __call__(self) -> float:
        """Return the time in s."""
        return self.now_ns * 1e-9

    def sleep(self, seconds: float) -> None:
        """Let time pass."""
        self.now_ns += max(0, round(seconds * 1e9))


class InProcessLink:
    """A :class:`~hilctl_drivers.wire.links.Link` that hands each request to a wire.

    Args:
        wire: Emulated devices and their framing.
        time: Its time.
        message_s: How long a request and its reply take.
    """

    def __init__(self, wire: ModbusWire, time: VirtualTime, message_s: float = 0.0) -> None:
        self._wire = wire
        self._time = time
        self._message_s = message_s
        self.is_open = False
        self.requests: list[bytes] = []
        """All requests, oldest first."""

    @property
    def name(self) -> str:
        """Where it leads."""
        return "in process"

    def open(self) -> None:
        """See :meth:`~hilctl_drivers.wire.links.Link.open`."""
        self.is_open = True

    def transact(self, request: bytes | bytearray, missing: Missing, usual: int = 0) -> bytes:
        """Exchange, see :meth:`~hilctl_drivers.wire.links.Link.transact`."""
        del usual
        if not self.is_open:
            raise LostError("not connected")
        self._time.sleep(self._message_s)
        self.requests.append(bytes(request))
        unread, reply = bytearray(request), b""
        for asked in self._wire.requests(unread):
            answer = self._wire.answer(asked, self._time.now_ns)
            reply += b"" if answer is None else self._wire.encode(answer.data)
        reply = self.spoil(reply)
        if unread or missing(bytearray(reply)):
            self.close()
            raise NoAnswerError(f"only {len(reply)} bytes" if reply else "no answer")
        return reply

    def spoil(self, reply: bytes) -> bytes:
        """Return what arrives of a reply; faults are made by overriding this."""
        return reply

    def close(self) -> None:
        """See :meth:`~hilctl_drivers.wire.links.Link.close`."""
        self.is_open = False


@dataclass(frozen=True, slots=True)
class InProcess:
    """An emulated device in the caller's process and time.

    Attributes:
        device: The device.
        rig: What it drives.
        link: Leads to it.
        time: Its time.
        log: What it writes; close it at the end.
    """

    device: EmulatedModbus
    rig: Rig
    link: InProcessLink
    time: VirtualTime
    log: WriteLog

    @classmethod
    def of(
        cls,
        profile: str,
        *,
        link: type[InProcessLink] = InProcessLink,
        log: Path | None = None,
        message_s: float = 0.0,
        noise: bool = False,
    ) -> "InProcess":
        """Put one together, with the profile's first output and input.

        Args:
            profile: Name of a shipped Modbus profile, or path of one.
            link: Makes the link.
            log: File for a log of every write.
            message_s: How long a request and its reply take.
            noise: Whether the sensor has noise.

        Raises:
            InputError: It is not a Modbus profile with an output and an input.
        """
        loaded = load_profile(profile)
        if not isinstance(loaded, ModbusProfile) or not (loaded.outputs and loaded.inputs):
            raise InputError(f"{profile}: only Modbus devices that drive and read are emulated so")
        output, sensor = next(iter(loaded.outputs)), next(iter(loaded.inputs))
        time = VirtualTime()
        rig, writes = Rig(time.now_ns, noise=noise), WriteLog(log, 0)
        device = EmulatedModbus(loaded, rig, writes, output, sensor)
        attach_stream(device, rig, writes, output, sensor, noise=noise)
        return cls(device, rig, link(ModbusWire("tcp", device), time, message_s), time, writes)
