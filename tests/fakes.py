"""Test doubles for several rooms: clocks, devices, hosts and links."""

import errno
import io
import json
import math
import os
import select
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import ClassVar

import numpy as np

from hilctl.base.device import DeviceInfo, DeviceOptions
from hilctl.base.errors import DeviceError
from hilctl.base.samples import BlockBatch, BlockHeader
from hilctl.loop.block import Block
from hilctl.loop.interlocks import AuxLimit, InterlockContext, Interlocks, InterlockSettings
from hilctl.loop.plan import AxisPlan, LoopPlan
from hilctl.run.run_folder import DeviceLocks
from hilctl_drivers.dac import ModbusStream
from hilctl_drivers.emulator.factory import Emulator, build
from hilctl_drivers.emulator.modbus_device import EmulatedModbus
from hilctl_drivers.emulator.modbus_wire import ModbusWire
from hilctl_drivers.emulator.options import EmulatorOptions, RigOptions
from hilctl_drivers.emulator.rig import Bench, SimulatedWiring, Stage, WiredRig, WriteLog
from hilctl_drivers.profile import load_profile
from hilctl_drivers.simulated.devices import SimulatedTerfenol, TerfenolOptions
from hilctl_drivers.transport.links import LostError, NoAnswerError

T7_OPTIONS = {
    "profile": "labjack_t7",
    "output": "DAC0",
    "input": "AIN0",
    "amplifier": {"gain_a_per_v": 4.0, "offset_a": -10.0},
    "sensor": {"um_per_v": 12.5},
    "watchdog": "none",
}
"""Options of a LabJack T7, without its address."""


@dataclass
class FakeClock:
    """A clock that advances in sleeps only; sleeps with given numbers last longer."""

    now: int = 0
    stall_ns: dict[int, int] = field(default_factory=dict)
    sleeps: int = 0

    def now_ns(self):
        return self.now

    def sleep_until_ns(self, deadline_ns):
        self.now = max(self.now, deadline_ns) + self.stall_ns.get(self.sleeps, 0)
        self.sleeps += 1


@dataclass
class ManualClock:
    """A clock in ns that the test advances."""

    now_ns: int = 1_000_000_000

    def __call__(self):
        return self.now_ns

    def pass_s(self, seconds):
        self.now_ns += round(seconds * 1e9)


@dataclass
class ShiftedClock:
    """The machine's clock in ns with an offset that the test advances."""

    extra_ns: int = 0

    def __call__(self):
        return time.monotonic_ns() + self.extra_ns


@dataclass
class SteppingClock:
    """A clock in s that advances by a step at each reading."""

    step_s: float = 0.0
    now: float = 0.0

    def __call__(self):
        self.now += self.step_s
        return self.now


@dataclass(frozen=True)
class FakeInfo:
    """Device info for the loop."""

    measures_command: bool = False
    ages_readings: bool = False
    corrects_readings: bool = False
    simulated: bool = False
    holds: tuple = ()
    confirms: bool = True
    arm_s: float = 0.0
    aux: tuple = ()
    digital_output: str = "DO"
    digital_input: str = "DI"


DESCRIBED = DeviceInfo(
    name="fake", description="a device that does nothing", command_unit="A", command_min=-8.0,
    command_max=8.0, sensor_min_um=-100.0, sensor_max_um=100.0, max_rate_hz=20e3,
)  # fmt: skip


@dataclass
class DescribedDevice:
    """A device that may not be opened or moved."""

    Options: ClassVar = DeviceOptions
    info: DeviceInfo = DESCRIBED

    def refuse(self, *_):
        raise AssertionError("opened or moved")

    open = output = exchange = make_safe = refuse

    def check_rate(self, sample_rate_hz, block): ...

    def close(self): ...


@dataclass
class FakeDevice:
    """A device that returns ten times the last command, and may fail at a sample."""

    output_at_open: float = 0.0
    break_at: int = 10**9
    nan_at: int = 10**9
    safe_works: bool = True
    commands: list[float] = field(default_factory=list)
    firsts: list[int] = field(default_factory=list)
    made_safe: list[float] = field(default_factory=list)
    info: FakeInfo = FakeInfo()

    def output(self):
        return self.output_at_open

    def exchange(self, first_sample, command, displacement_um, measured):
        if first_sample + command.size > self.break_at:
            raise DeviceError("fake: no answer within 0.1 s")
        self.firsts.append(first_sample)
        for j, value in enumerate(command):
            displacement_um[j] = 10.0 * (self.commands[-1] if self.commands else 0.0)
            if first_sample + j >= self.nan_at:
                displacement_um[j] = np.nan
            self.commands.append(float(value))

    def make_safe(self, command):
        if not self.safe_works:
            raise DeviceError("fake: still no answer")
        self.made_safe.append(command)


@dataclass
class FakeFifoDevice:
    """A FIFO device that returns ten times the previous command, ``latency`` exchanges later."""

    info = FakeInfo(measures_command=True)
    latency: int
    output_at_open: float = 0.0
    break_at: int = 10**9
    nan_at: int = 10**9
    commands: list[float] = field(default_factory=list)
    made_safe: list[float] = field(default_factory=list)
    exchanges: int = 0

    def output(self):
        return self.output_at_open

    def exchange(self, first_sample, command, displacement_um, measured):
        assert first_sample == len(self.commands)
        if first_sample + command.size > self.break_at:
            raise DeviceError("fake: no answer within 0.1 s")
        self.commands.extend(command.tolist())
        self.exchanges += 1
        first = first_sample - self.latency * command.size
        if first < 0:
            return
        before = [0.0, *self.commands]
        for j in range(command.size):
            played = first + j >= self.nan_at
            displacement_um[j] = np.nan if played else 10.0 * before[first + j]
            measured[j] = before[first + j + 1]

    def make_safe(self, command):
        self.made_safe.append(command)


class FakeHost:
    """A host of one axis, and its lane: it stores all blocks, and requests a stop or a tuning.

    Args:
        clock: The clock.
        block: Samples per block.
        state_size: State values per block.
        full: First samples of blocks that are dropped.
        stop: Returns the reason to end the run, or an empty text.
        tunings: Changes of the reference, by sample.
    """

    def __init__(
        self, clock, block=1, state_size=1, *, full=range(0), stop=lambda: "", tunings=None
    ):
        self.clock, self._shape = clock, (block, state_size)
        self.lanes = [self]
        self.full, self.stop, self.requested = full, stop, tunings or {}
        self.heads, self.columns, self.flags, self.states = [], [], [], []
        self.events, self.heartbeats, self.safe_writes = [], [], []
        self.sent = []  # first sample and commands of each pending block
        self.closed = False

    def claim(self, *, due=True):
        made = made_block(*self._shape)
        made.due = due
        return made

    def sending(self, block):
        self.sent.append((block.head[BlockHeader.FIRST_SAMPLE], block.command.tolist()))

    def answered(self, block):
        if block.head[BlockHeader.FIRST_SAMPLE] in self.full:
            return False
        self.heads.append(list(block.head))
        self.columns.append(block.columns.copy())
        self.flags.append(block.flags.copy())
        self.states.append(block.state.copy())
        return True

    def heartbeat(self, next_sample, late_ticks):
        self.heartbeats.append(next_sample)
        return self.stop()

    def starts_at(self, time_ns):
        self.start_ns = time_ns

    def closing(self):
        self.closed = True

    def tunings(self):
        tuning = self.requested.pop(self.heartbeats[-1], None)
        return [] if tuning is None else [(0, tuning)]

    def record_event(self, event):
        self.events.append(event)

    unanswered = False

    def exchanging(self, block):
        self.unanswered = True

    def note_safe_write(self, value, unanswered):
        self.safe_writes.append(value)

    def column(self, row):
        return np.concatenate([columns[row] for columns in self.columns])


def loop_plan(**options):
    """Return a plan of one axis, from the fields of both parts of a plan."""
    names = {each.name for each in fields(AxisPlan)}
    axis = AxisPlan(**{name: options.pop(name) for name in names & options.keys()})
    return LoopPlan(axes=(axis,), **options)


def made_block(block=1, state_size=1, fill=np.nan, aux=0):
    area = BlockBatch.empty(1, block, state_size, aux)
    area.columns[:] = fill
    return Block(area.heads[0].data.cast("B").cast("q"), area, 0)


@dataclass(frozen=True)
class RigInterlocks:
    """Rig properties and settings of interlocks in one, so that tests can vary them."""

    stroke_um: tuple[float, float]
    sensor_um: tuple[float, float] = (-math.inf, math.inf)
    unit: str = "A"
    safe: float = 0.0
    frozen_travel: float = math.inf
    heat_a2: float = 0.0
    aux: tuple[AuxLimit, ...] = ()
    sensor_invalid_s: float | None = None
    frozen_s: float | None = None
    frozen_um: float | None = None
    measured_deviation_a: float | None = None
    deviation_s: float | None = None
    rms_current_a: float | None = None
    thermal_time_constant_s: float | None = None
    tracking_error_um: float | None = None
    tracking_s: float | None = None

    def made(self, sample_rate_hz):
        return Interlocks(self.context, self.settings, sample_rate_hz)

    @property
    def context(self):
        names = InterlockContext.__dataclass_fields__
        return InterlockContext(**{name: getattr(self, name) for name in names})

    @property
    def settings(self):
        names = InterlockSettings.model_fields
        return InterlockSettings(**{k: v for k, v in asdict(self).items() if k in names})


@dataclass(slots=True)
class VirtualTime:
    """A clock in s that advances on request and by each message."""

    now_ns: int = 1_000_000_000

    def __call__(self):
        return self.now_ns * 1e-9

    def sleep(self, seconds):
        self.now_ns += max(0, round(seconds * 1e9))


class AnsweringLink:
    """A link that keeps what it was asked with, and answers with ``answer(request)``."""

    def __init__(self, answer=None):
        self.answer = answer
        self.request, self.missing, self.usual = b"", None, 0

    def transact(self, request, missing, usual=0):
        self.request, self.missing, self.usual = bytes(request), missing, usual
        return self.answer(self.request)


class InProcessLink:
    """A :class:`~hilctl_drivers.transport.links.Link` that passes each request to emulated devices.

    A request and its reply take ``message_s``; all requests are kept.
    """

    def __init__(self, wire: ModbusWire, time: VirtualTime, message_s=0.0):
        self._wire, self._time, self._message_s = wire, time, message_s
        self.is_open = False
        self.requests: list[bytes] = []

    def open(self):
        self.is_open = True

    def transact(self, request, missing, usual=0):
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

    def spoil(self, reply):
        """Return the received reply; override it to inject faults."""
        return reply

    def doubt(self):
        self.close()

    def close(self):
        self.is_open = False


_READ_FUNCTIONS = (1, 2, 3, 4)


def made_safe(device, command, attempts=50):
    """Call make_safe until the device confirms; return the number of attempts."""
    for attempt in range(1, attempts):
        try:
            device.make_safe(command)
        except DeviceError:
            continue
        return attempt
    device.make_safe(command)
    return attempts


class FaultyLink(InProcessLink):
    """A link that loses requests, or delays the next one that ``late_if`` selects (a write)."""

    timeout_s = 0.1
    silent_until_s = 0.0
    late_s: float | None = None

    def __init__(self, wire: ModbusWire, time: VirtualTime, message_s=0.0):
        super().__init__(wire, time, message_s)
        self.late_if = lambda request: request[7] not in _READ_FUNCTIONS
        self._held_back: list[tuple[float, bytes]] = []

    def transact(self, request, missing, usual=0):
        self.deliver()
        if self.late_s is not None and self.late_if(bytes(request)):
            self._held_back.append((self._time() + self.late_s, bytes(request)))
            self.late_s = None
        elif self._time() >= self.silent_until_s:
            return super().transact(request, missing, usual)
        self._time.sleep(self.timeout_s)
        self.close()
        raise NoAnswerError(f"no answer within {self.timeout_s:g} s")

    def deliver(self):
        """Execute the due requests without an answer."""
        for due_s, request in self._held_back:
            if due_s <= self._time():
                for asked in self._wire.requests(bytearray(request)):
                    self._wire.answer(asked, self._time.now_ns)
        self._held_back = [each for each in self._held_back if each[0] > self._time()]


@dataclass(frozen=True, slots=True)
class InProcess:
    """An emulated device in the caller's process, with virtual time; close its log at the end."""

    device: EmulatedModbus
    rigs: tuple[WiredRig, ...]
    link: InProcessLink
    time: VirtualTime
    log: WriteLog

    @classmethod
    def of(
        cls,
        profile,
        *,
        link=InProcessLink,
        log=None,
        message_s=0.0,
        noise=False,
        current_a=0.0,
        rigs=1,
    ):
        """Return an emulated device with the first outputs and inputs of a Modbus profile.

        Args:
            profile: Name of a shipped profile, or a path.
            link: Factory of the link.
            log: File for a log of every write.
            message_s: Duration of a request and its reply.
            noise: Whether the sensor has noise.
            current_a: Initial current; the power-up value if None.
            rigs: Rigs, each with an output and an input.
        """
        loaded = load_profile(profile)
        time, writes = VirtualTime(), WriteLog(log, 0)
        actuators = {n: SimulatedTerfenol(TerfenolOptions(noise=noise)) for n in range(rigs)}
        stage = Stage(time.now_ns, actuators)
        driven, shown = {}, {}
        for output, sensor, rig in zip(loaded.outputs, loaded.inputs, stage.rigs, strict=False):
            channels = loaded.outputs[output], loaded.inputs[sensor]
            wiring = SimulatedWiring.spread(*channels, rig.actuator)
            driven[output] = shown[sensor] = WiredRig(rig, wiring)
        device = EmulatedModbus(loaded, Bench(driven, shown, writes), current_a)
        wire = ModbusWire("tcp", {loaded.unit_id: device})
        return cls(device, tuple(driven.values()), link(wire, time, message_s), time, writes)

    def stream(self, options):
        """Return a modbus_stream on this device and in its time."""
        device = ModbusStream(options, self.link)
        buffer = device.wire.buffer
        buffer.sleep, buffer.clock = self.time.sleep, self.time
        return device

    @property
    def rig(self):
        """Its first rig."""
        return self.rigs[0].rig

    @property
    def options(self):
        """The options of a device that drives this one without a watchdog."""
        wiring, profile = self.rigs[0].wiring, self.device.profile
        return {
            "host": "127.0.0.1",
            "output": next(iter(profile.outputs)),
            "input": next(iter(profile.inputs)),
            "amplifier": wiring.amplifier.model_dump(),
            "sensor": wiring.sensor.model_dump(),
            "watchdog": "none",
        }


def one_rig(**options) -> tuple[RigOptions, ...]:
    """Return the options of an emulator's only rig."""
    return (RigOptions(**options),)


@contextmanager
def emulated(
    options: EmulatorOptions, clock_ns: Callable[[], int] = time.monotonic_ns
) -> Iterator[Emulator]:
    """Run an emulator in a thread; its ``options`` have its address."""
    emulator = build(options, clock_ns)
    thread = threading.Thread(target=emulator.server.run)
    thread.start()
    try:
        yield emulator
    finally:
        emulator.server.stop()
        thread.join()
        emulator.log.close()


def logged(path: Path) -> list[dict]:
    """Return the outputs in an emulated device's log, which may still grow."""
    *lines, _half = path.read_text(encoding="utf-8").split("\n")
    return [json.loads(line) for line in lines]


def children_of(process: int) -> list[int]:
    """Return the ids of a process's children."""
    children = Path(f"/proc/{process}/task/{process}/children")
    return [int(child) for child in children.read_text().split()]


def loop_of(supervisor: int) -> int:
    """Return the process id of a run's loop process."""
    for child in children_of(supervisor):
        if b"hilctl.run.loop_process" in Path(f"/proc/{child}/cmdline").read_bytes():
            return child
    raise AssertionError("the run has no loop process")


def received(descriptor: int, size: int, wait_s: float = 5.0) -> bytes:
    """Read a number of bytes from a line, in several parts if necessary."""
    got = b""
    while len(got) < size and select.select([descriptor], [], [], wait_s)[0]:
        got += os.read(descriptor, size - len(got))
    return got


class FailingFile(io.FileIO):
    """A file with write errors.

    Attributes:
        room: Free bytes; a write beyond is truncated, and the next one fails.
        write_errors: Error numbers of the next writes, in order; None for success.
    """

    def __init__(self, path, mode="r+b"):
        super().__init__(path, mode)
        self.room = 10**9
        self.write_errors = []

    def write(self, data):
        number = self.write_errors.pop(0) if self.write_errors else None
        if number is not None:
            raise OSError(number, os.strerror(number))
        fits = self.room - self.tell()
        if len(data) and fits <= 0:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return super().write(data[:fits])


@contextmanager
def held_devices(holds, **options):
    """Hold a device, as a run does."""
    with DeviceLocks(holds, **options) as locks:
        locks.acquire()
        yield
