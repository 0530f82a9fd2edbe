"""Doubles that tests of several rooms share: clocks, devices and hosts that do what a test says."""

import math
from collections.abc import Callable
from dataclasses import asdict, dataclass, field

import numpy as np

from hilctl.base.errors import DeviceError
from hilctl.base.events import Event
from hilctl.base.samples import COLUMNS, Head
from hilctl.loop.block import Block
from hilctl.loop.host import Tuning
from hilctl.loop.interlocks import InterlockContext, Interlocks, InterlockSettings


@dataclass
class FakeClock:
    """Time moves only in sleeps; some of them, by number, last longer."""

    now: int = 0
    stall_ns: dict[int, int] = field(default_factory=dict)
    sleeps: int = 0

    def now_ns(self):
        return self.now

    def sleep_until_ns(self, deadline_ns):
        self.now = max(self.now, deadline_ns) + self.stall_ns.get(self.sleeps, 0)
        self.sleeps += 1


@dataclass(frozen=True)
class FakeInfo:
    """What the loop asks of a device's info."""

    measures_command: bool = False


@dataclass
class FakeDevice:
    """Answers ten times the last command; may break at a sample."""

    info = FakeInfo()
    break_at: int = 10**9
    nan_at: int = 10**9
    safe_works: bool = True
    commands: list[float] = field(default_factory=list)
    firsts: list[int] = field(default_factory=list)
    made_safe: list[float] = field(default_factory=list)

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
    """Plays blocks later: the displacement of each sample is ten times the command before it.

    It hands out each block's displacements ``latency`` exchanges after it was sent.
    """

    info = FakeInfo(measures_command=True)
    latency: int
    break_at: int = 10**9
    nan_at: int = 10**9
    commands: list[float] = field(default_factory=list)
    made_safe: list[float] = field(default_factory=list)
    exchanges: int = 0

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
    """Keeps all that the loop gives it; asks for a stop or a tuning when told to.

    Args:
        clock: Time.
        block: Samples in a block.
        state_size: Numbers of state kept with each block.
        full: First samples of blocks that find no room.
        stop: Why the run should end, or an empty text.
        tunings: Changes of the reference by the sample at which they come.

    Attributes:
        heads: Numbers of each recorded block, by :class:`Head`.
        sent: First sample and commands of each block that was on its way, as they were then.
    """

    def __init__(
        self,
        clock,
        block=1,
        state_size=1,
        *,
        full=range(0),
        stop: Callable[[], str] = lambda: "",
        tunings: dict[int, Tuning] | None = None,
    ):
        self.clock, self._shape = clock, (block, state_size)
        self.full, self.stop, self.tunings = full, stop, tunings or {}
        self.heads, self.columns, self.flags, self.states = [], [], [], []
        self.events: list[Event] = []
        self.heartbeats: list[int] = []
        self.sent: list[tuple[int, list[float]]] = []
        self.closed = False

    def claim(self, *, due=True):
        made = made_block(*self._shape)
        made.due = due
        return made

    def sending(self, block):
        self.sent.append((block.head[Head.FIRST_SAMPLE], block.command.tolist()))

    def answered(self, block):
        if block.head[Head.FIRST_SAMPLE] in self.full:
            return False
        self.heads.append(list(block.head))
        self.columns.append(block.reference.base.copy())
        self.flags.append(block.flags.copy())
        self.states.append(block.state.copy())
        return True

    def heartbeat(self, next_sample, late_ticks):
        self.heartbeats.append(next_sample)
        return self.stop()

    def closing(self):
        self.closed = True

    def tuning(self):
        return self.tunings.pop(self.heartbeats[-1], None)

    def record_event(self, event):
        self.events.append(event)

    def column(self, row):
        return np.concatenate([columns[row] for columns in self.columns])


def made_block(block=1, state_size=1, fill=np.nan):
    """Return a block in memory of its own."""
    head = memoryview(bytearray(8 * len(Head))).cast("q")
    columns = np.full((len(COLUMNS), block), fill)
    return Block(head, np.zeros(state_size), columns, np.zeros(block, dtype=np.uint32))


@dataclass(frozen=True)
class RigInterlocks:
    """What interlocks know of a rig and what they are set to, in one, so that tests can vary it."""

    stroke_um: tuple[float, float]
    sensor_um: tuple[float, float] = (-math.inf, math.inf)
    unit: str = "A"
    safe: float = 0.0
    frozen_travel: float = math.inf
    frozen_s: float | None = None
    frozen_um: float | None = None
    measured_deviation_a: float | None = None
    deviation_s: float | None = None
    rms_current_a: float | None = None
    thermal_time_constant_s: float | None = None
    tracking_error_um: float | None = None
    tracking_s: float | None = None

    def made(self, sample_rate_hz):
        """Return the interlocks."""
        return Interlocks(self.context, self.settings, sample_rate_hz)

    @property
    def context(self):
        names = InterlockContext.__dataclass_fields__
        return InterlockContext(**{name: getattr(self, name) for name in names})

    @property
    def settings(self):
        names = InterlockSettings.model_fields
        return InterlockSettings(**{k: v for k, v in asdict(self).items() if k in names})
