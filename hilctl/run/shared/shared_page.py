"""The shared page of a run: numbers, texts and events of loop, supervisor and guardian.

Each number has one writer, and no process waits for another. A number that announces other data is
published and observed, in order with the data; see :mod:`hilctl.kernels.atomics`.

The guardian imports this module, so it must not import numba. The guardian only reads and writes
single numbers, and readers accept its text only as complete JSON.
"""

import json
from collections.abc import Callable
from contextlib import suppress
from dataclasses import asdict, astuple, dataclass, fields
from enum import IntEnum
from functools import cached_property
from mmap import mmap

import numpy as np

from hilctl.base.events import Event
from hilctl.base.types import F64, I64
from hilctl.loop.pacer import Lateness
from hilctl.loop.safe_output import LoopOutcome, OutputState
from hilctl.machine.procfs import ProcessUsage

_PAGE = 4096
_TEXT_BYTES = 4096
_EVENT_BYTES = 1024
_EVENT_SLOTS = 32
_READS = 3


class PageSlot(IntEnum):
    """Texts of loop and guardian for the supervisor."""

    SET_UP = 0  # set-up of the loop: JSON of all steps and of facts on the device, refused steps
    OUTCOME = 1  # outcome of the run: JSON of :class:`hilctl.loop.safe_output.LoopOutcome`
    ERROR = 2  # why the loop failed
    GUARDIAN = 3  # result of the guardian: JSON of :class:`SafeActionResult`, or why it failed


_EVENTS_AT = _PAGE + len(PageSlot) * _TEXT_BYTES
_NOTES_AT = _EVENTS_AT + _EVENT_SLOTS * _EVENT_BYTES
_NOTE_SLOTS = 32
SIZE = _NOTES_AT + _NOTE_SLOTS * _EVENT_BYTES  # size of the page in bytes


class PageField(IntEnum):
    """Numbers of the page, int64 each; gains, offsets and outputs are float64."""

    MAGIC = 0
    SLOTS = 1
    BLOCK = 2
    STATE_SIZE = 3
    SPARE = 4
    AUX = 5
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
    DROPPED = 39
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
    TUNE_NUMBER = 54  # change of the run that the page of an axis holds
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
    LAST_SAFE_WRITE = 78
    AWAITS_DEVICE = 79
    HAS_DEVICE = 80
    CLAIM = 81
    RELIEVED = 82
    STANDS_IN = 83
    UNANSWERED = 84
    MEAN_WAKE_NS = 85


class Phase(IntEnum):
    """Phase of the loop process."""

    STARTING = 0
    READY = 1
    RUNNING = 2
    ENDED = 3
    FAILED = 4
    REFUSED = 5
    CLOSING = 6


class GuardianPhase(IntEnum):
    """Phase of the guardian."""

    STARTING = 0
    WATCHING = 1
    ACTING = 2
    DONE = 3
    FAILED = 4
    WAITING = 5  # another process has the device; the guardian acts if that process ends


@dataclass(frozen=True, slots=True)
class SafeActionResult:
    """Result of setting the safe value in place of the loop."""

    hung: bool  # whether the loop hung and was killed
    output: OutputState
    error: str = ""  # why it is not confirmed; may be empty
    final: bool = True  # whether no further write follows

    @property
    def confirmed(self) -> bool:
        """Whether the device confirmed the safe value."""
        return self.output == "confirmed"


_ACTED = {GuardianPhase.ACTING, GuardianPhase.WAITING, GuardianPhase.DONE}


class Stop(IntEnum):
    """Why the supervisor stops the loop; 0: no stop."""

    CTRL_C = 1
    SIGTERM = 2
    SIGHUP = 3
    RECORDER_FAILED = 4
    REQUEST = 5
    RECORDER_STALLED = 6
    SUPERVISOR_BROKE = 7
    SUSPENDED = 8

    @property
    def reason(self) -> str:
        """The reason as text."""
        return _REASONS[self]


_REASONS = {
    Stop.CTRL_C: "stopped by Ctrl-C",
    Stop.SIGTERM: "stopped by SIGTERM",
    Stop.SIGHUP: "stopped by SIGHUP: the terminal was closed",
    Stop.RECORDER_FAILED: "stopped because the recording cannot be written",
    Stop.REQUEST: "stopped by hilctl stop",
    Stop.RECORDER_STALLED: "stopped because the disk stalls the recording",
    Stop.SUPERVISOR_BROKE: "stopped because the supervisor failed",
    Stop.SUSPENDED: "stopped because the computer was suspended: nothing commanded the output",
}


_LATENESS = (
    PageField.LATE_TICKS,
    PageField.SKIPPED_TICKS,
    PageField.WORST_LATE_NS,
    PageField.WORST_LATE_TICK,
    PageField.LONGEST_LATE_RUN,
    PageField.MEAN_WAKE_NS,
)
"""The fields of :class:`~hilctl.loop.pacer.Lateness`, in its order."""

_UNANSWERED = int(PageField.UNANSWERED)

_USAGE = tuple(PageField[field.name.upper()] for field in fields(ProcessUsage))


class SharedPage:
    """The page, for all processes."""

    def __init__(self, memory: mmap) -> None:
        self._map = memory
        self.integers: I64 = np.frombuffer(memory, dtype=np.int64, count=_PAGE // 8)
        """All numbers, int64[n]."""
        self.numbers = memoryview(memory)[:_PAGE].cast("q")
        """The same numbers as Python integers: three times as fast for single accesses."""
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
        """Set a number that announces other data, after them."""
        self.publishes(self.integers, field, value)

    def observe(self, field: PageField) -> int:
        """Return a number that announces other data, before they are read."""
        return self.observes(self.integers, field)

    def get_float(self, field: PageField) -> float:
        """Return a float64 number."""
        return float(self._floats[field])

    def put_float(self, field: PageField, value: float) -> None:
        """Set a float64 number."""
        self._floats[field] = value

    def write_text(self, place: PageSlot, text: str) -> None:
        """Write a text, truncated to its slot."""
        self._write(_PAGE + place * _TEXT_BYTES, _TEXT_BYTES, text)

    def read_text(self, place: PageSlot) -> str:
        """Return a text."""
        return self._read(_PAGE + place * _TEXT_BYTES, _TEXT_BYTES)

    def lateness(self) -> Lateness:
        """Return the loop's counters of late ticks."""
        return Lateness(*map(self.get, _LATENESS))

    def leave_lateness(self, lateness: Lateness) -> None:
        """Write the counters of late ticks."""
        for field, count in zip(_LATENESS, astuple(lateness), strict=True):
            self.put(field, count)

    def losses(self) -> tuple[int, int]:
        """Return the samples and the events for which ring and page had no room."""
        return self.get(PageField.DROPPED), self.get(PageField.EVENTS_LOST)

    def usage(self) -> ProcessUsage | None:
        """Return the resource usage of the loop process, or None."""
        found = ProcessUsage(*map(self.get, _USAGE))
        return found if found.resident_bytes else None

    def leave_usage(self, usage: ProcessUsage) -> None:
        """Write the resource usage of the loop process."""
        for field, value in zip(_USAGE, astuple(usage), strict=True):
            self.put(field, value)

    def leave_outcome(self, outcome: LoopOutcome) -> None:
        """Write the outcome of the run."""
        self.write_text(PageSlot.OUTCOME, json.dumps(asdict(outcome)))
        # After the text, which the phase announces.
        self.publish(PageField.PHASE, Phase.ENDED)

    def state(self) -> str:
        """Return the state of the run in one word: ``waiting`` is that for its trigger."""
        if self.get(PageField.STOP):
            return "stopping"
        phase = Phase(self.get(PageField.PHASE))
        return "waiting" if phase is Phase.READY and self.get(PageField.GO) else phase.name.lower()

    def outcome(self) -> LoopOutcome | None:
        """Return the outcome that the loop wrote, or None."""
        if self.observe(PageField.PHASE) != Phase.ENDED:
            return None
        with suppress(ValueError, TypeError):  # damaged
            return LoopOutcome(**json.loads(self.read_text(PageSlot.OUTCOME)))
        return None

    def note_safe_write(self, value: float, unanswered: bool) -> None:
        """Note a write of the safe ramp, so that another process can continue it.

        ``unanswered``: whether a command may still be executed later.
        """
        self.numbers[_UNANSWERED] = unanswered
        # One number, because the guardian cannot publish; a written 0 is -0.0, none is 0.0.
        self.put_float(PageField.LAST_SAFE_WRITE, value or -0.0)

    def last_safe_write(self) -> float | None:
        """Return the last value of the safe ramp; None before the first."""
        if self.get(PageField.LAST_SAFE_WRITE) == 0:
            return None
        return self.get_float(PageField.LAST_SAFE_WRITE) + 0.0

    def is_settled(self) -> bool:
        """Return whether the output of a run without supervisor needs no attention."""
        over = self.get(PageField.RELIEVED) or not self.get(PageField.GO)
        done = self.get(PageField.GUARDIAN_PHASE) == GuardianPhase.DONE
        return bool(over) or done or self.ended_safely()

    def ended_safely(self) -> bool:
        """Return whether the loop ended with a safe output."""
        if self.get(PageField.PHASE) != Phase.ENDED:
            return False
        with suppress(ValueError, TypeError):  # damaged
            # Without outcome(), which imports numba: the guardian calls this.
            return json.loads(self.read_text(PageSlot.OUTCOME))["output"] in {"confirmed", "sent"}
        return False

    def leave_safe_result(self, result: SafeActionResult) -> None:
        """Write the guardian's result so far, for the supervisor and later commands."""
        self.write_text(PageSlot.GUARDIAN, json.dumps(asdict(result)))
        # After the text, which the phase announces.
        if result.final:
            self.put(PageField.GUARDIAN_PHASE, GuardianPhase.DONE)

    def safe_result(self) -> SafeActionResult | None:
        """Return the guardian's result so far; None if it has not acted."""
        if self.get(PageField.GUARDIAN_PHASE) not in _ACTED:
            return None
        for _ in range(_READS):  # the guardian may be writing it
            with suppress(ValueError, TypeError):
                return SafeActionResult(**json.loads(self.read_text(PageSlot.GUARDIAN)))
        return None

    def push_event(self, event: Event) -> None:
        """Write an event; without a free slot it is counted as lost."""
        head = self.get(PageField.EVENT_HEAD)
        if head - self.observe(PageField.EVENT_TAIL) >= _EVENT_SLOTS:
            self.integers[PageField.EVENTS_LOST] += 1
            return
        self._write(_EVENTS_AT + head % _EVENT_SLOTS * _EVENT_BYTES, _EVENT_BYTES, _packed(event))
        # Last: a counted event is complete.
        self.publish(PageField.EVENT_HEAD, head + 1)

    def look_at_events(self, since: int) -> tuple[list[Event], int]:
        """Return the events from ``since`` on that are still there, and the next number."""
        return self._look(PageField.EVENT_HEAD, _EVENTS_AT, _EVENT_SLOTS, since)

    def leave_note(self, event: Event) -> None:
        """Show an event of the supervisor to watchers; the recorder has it already."""
        head = self.get(PageField.NOTE_HEAD)
        self._write(_NOTES_AT + head % _NOTE_SLOTS * _EVENT_BYTES, _EVENT_BYTES, _packed(event))
        # Last: a counted note is complete.
        self.publish(PageField.NOTE_HEAD, head + 1)

    def look_at_notes(self, since: int) -> tuple[list[Event], int]:
        """Return the notes from number ``since`` on, and the next number."""
        return self._look(PageField.NOTE_HEAD, _NOTES_AT, _NOTE_SLOTS, since)

    def _look(self, cursor: PageField, at: int, slots: int, since: int) -> tuple[list[Event], int]:
        head, found = self.observe(cursor), []
        for number in range(max(since, head - slots), head):
            raw = self._read(at + number % slots * _EVENT_BYTES, _EVENT_BYTES)
            # Checked after the copy: the slot may have been overwritten meanwhile.
            if self.observe(cursor) < number + slots or self._is_kept(cursor, number):
                with suppress(ValueError, TypeError):  # damaged: the recorder counts it
                    found.append(Event(**json.loads(raw)))
        return found, max(head, since)

    def _is_kept(self, cursor: PageField, number: int) -> bool:
        """Return whether the slot of an event has not been released to the loop."""
        return cursor == PageField.EVENT_HEAD and self.observe(PageField.EVENT_TAIL) <= number

    def pop_events(self) -> list[Event]:
        """Consume the new events; their slots stay until :meth:`release_events`."""
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
        """Release the slots of consumed events; the events are on disk."""
        self.publish(PageField.EVENT_TAIL, self._event_tail)

    def _write(self, at: int, size: int, text: str) -> None:
        raw = text.encode(errors="backslashreplace")[: size - 8].decode(errors="ignore").encode()
        self._map[at + 8 : at + 8 + len(raw)] = raw
        self._map[at : at + 8] = len(raw).to_bytes(8, "little")

    def _read(self, at: int, size: int) -> str:
        length = min(int.from_bytes(self._map[at : at + 8], "little"), size - 8)
        return bytes(self._map[at + 8 : at + 8 + length]).decode(errors="replace")


def _packed(event: Event) -> str:
    """Return an event as JSON that fits into a slot: long text is cut, long values omitted."""
    room = _EVENT_BYTES - 8
    facts, text = asdict(event), event.text[:room]
    if len(json.dumps({**facts, "text": ""})) > room:
        facts["values"] = {}
    while len(raw := json.dumps({**facts, "text": text})) > room and text:
        text = text[: len(text) * 3 // 4]
    return raw[:room]
