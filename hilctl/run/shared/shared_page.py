"""What loop, supervisor and guardian pass to each other in shared memory: numbers, texts, events.

Each number has one writer, and is written whole. Nobody ever waits for the other. A number that
says that others, a text, events or blocks are there is published and observed, in order with them;
see :mod:`hilctl.kernels.atomics`.

The guardian imports this: nothing of the loop or of the kernels may be imported here before it is
needed, as it brings numba along. The guardian itself neither publishes nor observes: it looks at
single numbers, and the supervisor takes its text only once that is whole JSON.
"""

import json
from collections.abc import Callable
from contextlib import suppress
from dataclasses import asdict, astuple, dataclass
from enum import IntEnum
from functools import cached_property
from mmap import mmap
from typing import TYPE_CHECKING

import numpy as np

from hilctl.base.events import Event
from hilctl.base.types import F64, I64
from hilctl.loop.safe_output import OutputState

if TYPE_CHECKING:
    from hilctl.loop.pacer import Lateness
    from hilctl.loop.safe_output import LoopOutcome
    from hilctl.machine.procfs import ProcessUsage

_PAGE = 4096
_TEXT_BYTES = 4096
_EVENT_BYTES = 1024
_EVENT_SLOTS = 32
_READS = 3


class PageSlot(IntEnum):
    """Texts that loop and guardian leave for the supervisor, each in a place of its own."""

    SET_UP = 0
    """How its process was set up: JSON of names and what became of each, and of what was refused
    that real time needs."""
    OUTCOME = 1
    """How the run ended: JSON of :class:`hilctl.loop.plan.LoopOutcome`."""
    ERROR = 2
    """Why it could not start or go on, for people."""
    GUARDIAN = 3
    """What the guardian did: JSON of :class:`SafeActionResult`, or why it failed, for people."""


_EVENTS_AT = _PAGE + len(PageSlot) * _TEXT_BYTES
_NOTES_AT = _EVENTS_AT + _EVENT_SLOTS * _EVENT_BYTES
_NOTE_SLOTS = 32
SIZE = _NOTES_AT + _NOTE_SLOTS * _EVENT_BYTES
"""Bytes that the numbers, the texts and the events take."""


class PageField(IntEnum):
    """Numbers of the page, int64 each; what a change leads to, but its samples, is float64."""

    MAGIC = 0
    SLOTS = 1
    BLOCK = 2
    STATE_SIZE = 3
    SPARE = 4
    SENT = 7
    HEAD = 8
    TAIL = 16
    CLEANED = 17
    PHASE = 24
    GO = 25
    STOP = 26
    LOOP_HEARTBEAT_NS = 27
    SUPERVISOR_HEARTBEAT_NS = 28
    START_NS = 29
    NEXT_SAMPLE = 30
    ENDED_AT = 31
    LATE_TICKS = 32
    SKIPPED_TICKS = 33
    WORST_LATE_NS = 34
    WORST_LATE_TICK = 35
    LONGEST_LATE_RUN = 36
    WAVEFORM_AT = 37
    EXCHANGING = 38
    EVENT_HEAD = 40
    EVENT_TAIL = 41
    EVENTS_LOST = 42
    NOTE_HEAD = 43
    TUNE_WANTED = 48
    TUNE_TAKEN = 49
    TUNE_GAIN = 50
    TUNE_OFFSET = 51
    TUNE_SAMPLES = 52
    GUARDIAN_HEARTBEAT_NS = 56
    GUARDIAN_PHASE = 57
    TUNE_BEGINS_AT = 53
    TUNE_INVERSE_SHARE = 58
    TUNE_LINE_SLOPE = 59
    TUNE_LINE_AT_ZERO = 60
    RESIDENT_BYTES = 64
    CPU_NS = 65
    MINOR_FAULTS = 66
    MAJOR_FAULTS = 67
    INVOLUNTARY_SWITCHES = 68
    OUTPUT_AT_START = 73
    REAL_TIME = 74
    RECORDED = 75
    GUARDIAN_PID = 76
    SAFE_WRITES = 77
    LAST_SAFE_WRITE = 78


class Phase(IntEnum):
    """How far the loop process has come."""

    STARTING = 0
    READY = 1
    RUNNING = 2
    ENDED = 3
    FAILED = 4
    REFUSED = 5
    CLOSING = 6


class GuardianPhase(IntEnum):
    """How far the guardian has come."""

    STARTING = 0
    WATCHING = 1
    ACTING = 2
    DONE = 3
    FAILED = 4


@dataclass(frozen=True, slots=True)
class SafeActionResult:
    """What came of setting the output to its safe value in place of a loop that cannot.

    Attributes:
        hung: Whether the loop was alive, but silent, and was killed.
        output: What is known of the output.
        error: Why it is not confirmed; empty if no write failed since.
        final: Whether no further write follows.
    """

    hung: bool
    output: OutputState
    error: str = ""
    final: bool = True

    @property
    def confirmed(self) -> bool:
        """Whether the device confirmed the safe value."""
        return self.output == "confirmed"


class Stop(IntEnum):
    """Why the supervisor has the loop stop; 0 is for no stop."""

    CTRL_C = 1
    SIGTERM = 2
    SIGHUP = 3
    RECORDER_FAILED = 4
    REQUEST = 5
    RECORDER_STALLED = 6
    SUPERVISOR_BROKE = 7

    @property
    def reason(self) -> str:
        """In words."""
        return _REASONS[self]


_REASONS = {
    Stop.CTRL_C: "stopped by Ctrl-C",
    Stop.SIGTERM: "stopped by SIGTERM",
    Stop.SIGHUP: "stopped by SIGHUP: the terminal went away",
    Stop.RECORDER_FAILED: "stopped because the recording can't be written",
    Stop.REQUEST: "stopped by hilctl stop",
    Stop.RECORDER_STALLED: "stopped because the disk keeps the recording waiting",
    Stop.SUPERVISOR_BROKE: "stopped because the supervisor broke",
}


_LATENESS = (
    PageField.LATE_TICKS,
    PageField.SKIPPED_TICKS,
    PageField.WORST_LATE_NS,
    PageField.WORST_LATE_TICK,
    PageField.LONGEST_LATE_RUN,
)
"""Where each field of :class:`~hilctl.loop.pacer.Lateness` stands, in its order."""

_USAGE = (
    PageField.RESIDENT_BYTES,
    PageField.CPU_NS,
    PageField.MINOR_FAULTS,
    PageField.MAJOR_FAULTS,
    PageField.INVOLUNTARY_SWITCHES,
)
"""Where each field of :class:`~hilctl.machine.procfs.ProcessUsage` stands, in its order."""


class SharedPage:
    """The page, seen from either side.

    Args:
        memory: Shared memory of at least :data:`SIZE` bytes; the page stands at its start.
    """

    def __init__(self, memory: mmap) -> None:
        self._map = memory
        self.integers: I64 = np.frombuffer(memory, dtype=np.int64, count=_PAGE // 8)
        """All numbers, int64[n]."""
        self.numbers = memoryview(memory)[:_PAGE].cast("q")
        """The same numbers as Python's own: three times as fast to read and write singly."""
        self._floats: F64 = np.frombuffer(memory, dtype=np.float64, count=_PAGE // 8)
        self._event_tail = self.get(PageField.EVENT_TAIL)

    def get(self, field: PageField) -> int:
        """Return a number."""
        return int(self.integers[field])

    def put(self, field: PageField, value: int) -> None:
        """Set a number."""
        self.integers[field] = value

    @cached_property
    def publishes(self) -> Callable[[I64, int, int], None]:
        """:func:`hilctl.kernels.atomics.publish`, for the page's numbers."""
        from hilctl.kernels.atomics import publish

        return publish

    @cached_property
    def observes(self) -> Callable[[I64, int], int]:
        """:func:`hilctl.kernels.atomics.observe`, for the page's numbers."""
        from hilctl.kernels.atomics import observe

        return observe

    def publish(self, field: PageField, value: int) -> None:
        """Set a number that says of others that they are there, after them."""
        self.publishes(self.integers, field, value)

    def observe(self, field: PageField) -> int:
        """Return a number that says of others that they are there, before they are read."""
        return self.observes(self.integers, field)

    def get_float(self, field: PageField) -> float:
        """Return a number that is no whole one."""
        return float(self._floats[field])

    def put_float(self, field: PageField, value: float) -> None:
        """Set a number that is no whole one."""
        self._floats[field] = value

    def write_text(self, place: PageSlot, text: str) -> None:
        """Leave a text for the other side, cut to what fits."""
        self._write(_PAGE + place * _TEXT_BYTES, _TEXT_BYTES, text)

    def read_text(self, place: PageSlot) -> str:
        """Return the text that the other side left."""
        return self._read(_PAGE + place * _TEXT_BYTES, _TEXT_BYTES)

    def lateness(self) -> "Lateness":
        """Return the counters of late ticks that the loop left."""
        from hilctl.loop.pacer import Lateness

        return Lateness(*map(self.get, _LATENESS))

    def leave_lateness(self, lateness: "Lateness") -> None:
        """Leave the counters of late ticks for the supervisor."""
        for field, count in zip(_LATENESS, astuple(lateness), strict=True):
            self.put(field, count)

    def usage(self) -> "ProcessUsage | None":
        """Return what the loop's process said that its run took; None where it said nothing."""
        from hilctl.machine.procfs import ProcessUsage

        found = ProcessUsage(*map(self.get, _USAGE))
        return found if found.resident_bytes else None

    def leave_usage(self, usage: "ProcessUsage") -> None:
        """Leave what the run took of the loop's process for the supervisor."""
        for field, value in zip(_USAGE, astuple(usage), strict=True):
            self.put(field, value)

    def leave_outcome(self, outcome: "LoopOutcome") -> None:
        """Leave how the run ended for the supervisor."""
        self.write_text(PageSlot.OUTCOME, json.dumps(asdict(outcome)))
        # The text first: the phase says that it is there.
        self.publish(PageField.PHASE, Phase.ENDED)

    def outcome(self) -> "LoopOutcome | None":
        """Return how the loop said that the run ended; None where it said nothing."""
        from hilctl.loop.safe_output import LoopOutcome

        if self.observe(PageField.PHASE) != Phase.ENDED:
            return None
        with suppress(ValueError, TypeError):  # damaged
            return LoopOutcome(**json.loads(self.read_text(PageSlot.OUTCOME)))
        return None

    def note_safe_write(self, value: float) -> None:
        """Note a write on the way to the safe value, so that another process can go on from it."""
        self.put_float(PageField.LAST_SAFE_WRITE, value)
        # The value first: the count says that it is there.
        self.put(PageField.SAFE_WRITES, self.get(PageField.SAFE_WRITES) + 1)

    def last_safe_write(self) -> float | None:
        """Return the last value written on the way to the safe value; None before the first."""
        return (
            self.get_float(PageField.LAST_SAFE_WRITE) if self.get(PageField.SAFE_WRITES) else None
        )

    def ended_safely(self) -> bool:
        """Return whether the loop said how it ended, and no further write is needed."""
        if self.get(PageField.PHASE) != Phase.ENDED:
            return False
        with suppress(ValueError, TypeError):  # damaged
            # Not by outcome(), which imports numba: the guardian calls this.
            return json.loads(self.read_text(PageSlot.OUTCOME))["output"] in {"confirmed", "sent"}
        return False

    def leave_safe_result(self, result: SafeActionResult) -> None:
        """Leave what the guardian has reached so far, for the supervisor and later commands."""
        self.write_text(PageSlot.GUARDIAN, json.dumps(asdict(result)))
        # The text first: the phase says that it is there.
        if result.final:
            self.put(PageField.GUARDIAN_PHASE, GuardianPhase.DONE)

    def safe_result(self) -> SafeActionResult | None:
        """Return what the guardian has reached so far; None if it has not acted."""
        if self.get(PageField.GUARDIAN_PHASE) not in {GuardianPhase.ACTING, GuardianPhase.DONE}:
            return None
        for _ in range(_READS):  # the guardian may be writing it
            with suppress(ValueError, TypeError):
                return SafeActionResult(**json.loads(self.read_text(PageSlot.GUARDIAN)))
        return None

    def push_event(self, event: Event) -> None:
        """Leave an event; where there is no room it is counted as lost."""
        head = self.get(PageField.EVENT_HEAD)
        if head - self.observe(PageField.EVENT_TAIL) >= _EVENT_SLOTS:
            self.integers[PageField.EVENTS_LOST] += 1
            return
        self._write(_EVENTS_AT + head % _EVENT_SLOTS * _EVENT_BYTES, _EVENT_BYTES, _packed(event))
        # Last: an event that is counted is whole.
        self.publish(PageField.EVENT_HEAD, head + 1)

    def look_at_events(self, since: int) -> tuple[list[Event], int]:
        """Return the events from number ``since`` on that still stand there; takes nothing out.

        Returns:
            The events, and the number after the last of all.
        """
        head, found = self.observe(PageField.EVENT_HEAD), []
        for number in range(max(since, head - _EVENT_SLOTS), head):
            raw = self._read(_EVENTS_AT + number % _EVENT_SLOTS * _EVENT_BYTES, _EVENT_BYTES)
            # Looked at again: the loop may have begun a new one in a slot that was released.
            kept = self.observe(PageField.EVENT_TAIL) <= number
            if kept or self.observe(PageField.EVENT_HEAD) < number + _EVENT_SLOTS:
                with suppress(ValueError, TypeError):  # damaged: the recorder counts it
                    found.append(Event(**json.loads(raw)))
        return found, max(head, since)

    def leave_note(self, event: Event) -> None:
        """Show an event of the supervisor to those who look on; the recorder has it already.

        The oldest gives way: nobody takes it out.
        """
        head = self.get(PageField.NOTE_HEAD)
        self._write(_NOTES_AT + head % _NOTE_SLOTS * _EVENT_BYTES, _EVENT_BYTES, _packed(event))
        # Last: a note that is counted is whole.
        self.publish(PageField.NOTE_HEAD, head + 1)

    def look_at_notes(self, since: int) -> tuple[list[Event], int]:
        """Return the notes from number ``since`` on that still stand there, and the next number."""
        head, found = self.observe(PageField.NOTE_HEAD), []
        for number in range(max(since, head - _NOTE_SLOTS), head):
            raw = self._read(_NOTES_AT + number % _NOTE_SLOTS * _EVENT_BYTES, _EVENT_BYTES)
            # Looked at again: a new one may have been begun in its slot.
            if self.observe(PageField.NOTE_HEAD) < number + _NOTE_SLOTS:
                with suppress(ValueError, TypeError):
                    found.append(Event(**json.loads(raw)))
        return found, max(head, since)

    def pop_events(self) -> list[Event]:
        """Take the events that came since; they keep their room until they are released."""
        head, found = self.observe(PageField.EVENT_HEAD), []
        first = max(self._event_tail, head - _EVENT_SLOTS)
        for number in range(first, head):
            raw = self._read(_EVENTS_AT + number % _EVENT_SLOTS * _EVENT_BYTES, _EVENT_BYTES)
            try:
                found.append(Event(**json.loads(raw)))
            except (ValueError, TypeError):
                self.integers[PageField.EVENTS_LOST] += 1  # damaged
        self._event_tail = head
        return found

    def release_events(self) -> None:
        """Give the room of all events that were taken back to the loop: they are safe elsewhere."""
        self.publish(PageField.EVENT_TAIL, self._event_tail)

    def _write(self, at: int, size: int, text: str) -> None:
        raw = text.encode()[: size - 8].decode(errors="ignore").encode()
        self._map[at + 8 : at + 8 + len(raw)] = raw
        self._map[at : at + 8] = len(raw).to_bytes(8, "little")

    def _read(self, at: int, size: int) -> str:
        length = min(int.from_bytes(self._map[at : at + 8], "little"), size - 8)
        return bytes(self._map[at + 8 : at + 8 + length]).decode(errors="replace")


def _packed(event: Event) -> str:
    """Return an event as JSON that fits into a slot.

    A text that is too long is cut. Values that alone are too long are left out: the loop must not
    look for some that fit.
    """
    room = _EVENT_BYTES - 8
    facts, text = asdict(event), event.text[:room]
    if len(json.dumps({**facts, "text": ""})) > room:
        facts["values"] = {}
    while len(raw := json.dumps({**facts, "text": text})) > room and text:
        text = text[: len(text) * 3 // 4]
    return raw[:room]
