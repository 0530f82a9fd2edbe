"""The safe value: repeated writes until the device confirms it, and the outcome of a run.

The loop, the guardian, the supervisor and ``hilctl safe`` use this module. A device performs single
writes (:meth:`hilctl.base.device.Device.make_safe`) and never retries.
"""

import errno
import os
import threading
import time
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass
from typing import Literal, NamedTuple, Protocol, TypeAlias, TypeVar, cast

from hilctl.base.device import Device, DigitalDevice
from hilctl.base.errors import DeviceError, UnconfirmedError

OutputState: TypeAlias = Literal["confirmed", "set", "sent", "unknown"]
"""State of the output at the end of a run.

``confirmed``: the device confirmed the safe value, and no older command can still be executed.
``set``: the device confirmed the safe value, but an unconfirmed older one may still be executed.
``sent``: the safe value was sent to a device that cannot confirm it.
``unknown``: the safe value is not confirmed.
"""

Code: TypeAlias = Literal["completed", "stopped", "fault"]

PATIENCE_S = 4.0
"""Time that a command waits for confirmation before the guardian takes over."""
_RAMP_S = 0.005
_RETRY_S = 0.05
_LATER_RETRY_S = 0.5
_REPEAT_S = 0.2
PATIENT_AFTER_S = 60.0
"""Time during which the safe value is repeated quickly."""
PATIENT_PAUSE_S = 1.0
"""Pause between two attempts after that."""
_SENDS = 5
_OWN_ERRORS = {errno.EMFILE, errno.ENFILE, errno.ENOMEM, errno.ENOBUFS}


_DESCRIPTIONS: dict[OutputState, str] = {
    "confirmed": "the output is at its safe value, confirmed by the device",
    "set": "the safe value is set, but not yet confirmed to hold: "
    "an older command that the device did not confirm may still be executed",
    "sent": "the safe value was sent, but could not be confirmed: this device cannot report it",
    "unknown": "the safe value could not be confirmed",
}


def describe(state: OutputState, error: str = "") -> str:
    """Return a description of the output's state; ``error`` is the reason if unconfirmed."""
    return f"{_DESCRIPTIONS[state]}: {error}" if error else _DESCRIPTIONS[state]


@dataclass(frozen=True, slots=True)
class LoopOutcome:
    """Outcome of a run.

    Attributes:
        code: ``completed``, ``stopped`` on request, or ``fault``.
        reason: One line of text.
        ended_at: Index after the last sample that was sent.
        output: State of the output.
    """

    code: Code
    reason: str
    ended_at: int
    output: OutputState

    @property
    def safe(self) -> bool:
        """Whether the device confirmed its safe value."""
        return self.output == "confirmed"


class LocalError(Exception):
    """This process lacks memory or descriptors for the device; another process may have them."""


@dataclass(frozen=True, slots=True)
class SafeGoal:
    """Target of the output, and the ramp to it.

    Attributes:
        value: The safe value, in the device's command unit.
        ramp_per_s: Slew rate of the ramp, > 0.
        start: Last command; None if unknown, then there is no ramp.
        pending: Whether an unconfirmed command may still be executed.
    """

    value: float
    ramp_per_s: float
    start: float | None
    pending: bool


class OutputReport(NamedTuple):
    """State of one output, or of several together.

    Attributes:
        error: Why it is not confirmed; may be empty.
        final: Whether further writes cannot change it.
    """

    state: OutputState
    error: str
    final: bool

    @property
    def settled(self) -> bool:
        """Whether waiting gains nothing: the guardian watches a value that is only set."""
        return self.final or self.state == "set"


class SafeOutput:
    """Drive one device to its safe value; :func:`drive_in_turn` calls :meth:`attempt`.

    The ramp is a function of time, so a slow device gets fewer and larger steps.

    Args:
        device: Open or not.
        goal: The safe value and the ramp to it.
        began_s: Time at which the ramp begins, common to all outputs of a run.
        clock: Monotonic time in s.
        note: Called before and after each write, with the value, and with whether a command may
            still be executed later.

    Attributes:
        report: State of the output.
        due_s: Time of the next attempt.
        pause_s: Pause before it, s.
    """

    def __init__(
        self,
        device: Device,
        goal: SafeGoal,
        began_s: float,
        clock: Callable[[], float] = time.monotonic,
        note: Callable[[float, bool], None] = lambda value, unanswered: None,
    ) -> None:
        self.device, self.clock = device, clock
        self._goal, self._note = goal, note
        if device.info.digital_output:
            # Not with the first write, because the safe ramp must not wait for it.
            cast(DigitalDevice, device).safe_command = goal.value
        self._pending = goal.pending
        self._began_s = began_s - _RAMP_S
        self._sends = 0
        self.pause_s, self.due_s = 0.0, began_s
        self.report = OutputReport("unknown", "nothing was sent", final=False)

    @property
    def give_up_s(self) -> float:
        """Time until which a command waits for the confirmation."""
        goal = self._goal
        ramp_s = 0.0 if goal.start is None else abs(goal.start - goal.value) / goal.ramp_per_s
        return self._began_s + _RAMP_S + ramp_s + PATIENCE_S

    def attempt(self) -> None:
        """Write once; update the report and the time of the next attempt.

        Raise LocalError if this process lacks memory or descriptors.
        """
        passed_s = self.clock() - self._began_s
        value = self._value(passed_s)
        try:
            self._write(value, passed_s)
        finally:
            self._note(value, self._pending)
            self.due_s = self.clock() + self.pause_s

    def _write(self, value: float, passed_s: float) -> None:
        least_s = PATIENT_PAUSE_S if passed_s > PATIENT_AFTER_S else 0.0
        at_goal, confirmed = value == self._goal.value, True
        # Until it is answered, a step of the ramp may be executed after later ones.
        self._note(value, self._pending or not at_goal)
        try:
            self.device.make_safe(value)
        except UnconfirmedError:
            confirmed = False
        except DeviceError as error:
            local = _is_local(error)
            self._pending |= not at_goal and not local
            self.pause_s = _RETRY_S if passed_s <= PATIENCE_S else max(_LATER_RETRY_S, least_s)
            self.report = OutputReport("unknown", str(error), final=False)
            if local:
                self.pause_s = _RAMP_S
                raise LocalError(str(error)) from error
            return
        if not at_goal:
            self.pause_s = _RAMP_S
            self.report = OutputReport("unknown", "on the safe ramp", final=False)
            return
        self.pause_s = max(_REPEAT_S, least_s)
        self._sends += not confirmed
        state: OutputState = "sent" if not confirmed else "set" if self._pending else "confirmed"
        final = self._sends >= _SENDS if state == "sent" else state == "confirmed"
        self.report = OutputReport(state, "", final)

    def _value(self, passed_s: float) -> float:
        goal = self._goal
        if goal.start is None:
            return goal.value
        step = goal.ramp_per_s * passed_s
        if goal.start > goal.value:
            return max(goal.value, goal.start - step)
        return min(goal.value, goal.start + step)


def drive_in_turn(
    outputs: Sequence[SafeOutput],
    is_over: Callable[[], bool],
    wait: Callable[[float], object],
    spare: Callable[[], bool] = lambda: True,
) -> None:
    """Attempt each output when it is due, until all are final.

    Args:
        outputs: Those of one line, see :func:`lines_of`.
        is_over: Called after each attempt; returns True to end.
        wait: Waits that many s; returns True to end.
        spare: Called if this process lacks memory or descriptors; returns False to give up, which
            raises LocalError.
    """
    while left := [each for each in outputs if not each.report.final]:
        output = min(left, key=lambda each: each.due_s)
        pause_s = output.due_s - output.clock()
        if pause_s > 0.0 and wait(pause_s):
            return
        try:
            output.attempt()
        except LocalError:
            if not spare():
                raise
        if is_over():
            return


class _Driven(Protocol):
    @property
    def device(self) -> Device: ...


_D = TypeVar("_D", bound=_Driven)


def lines_of(driven: Iterable[_D]) -> list[list[_D]]:
    """Return what has a device, by lines.

    Devices that share a resource are on one line: they are used in turn, so that no two connections
    collide. Other devices do not wait for each other's timeouts.
    """
    lines: list[tuple[set[str], list[_D]]] = []
    for each in driven:
        holds = set(each.device.info.holds)
        shared = [line for line in lines if line[0] & holds]
        lines = [line for line in lines if not line[0] & holds]
        joined = [one for _, line in shared for one in line]
        lines.append((holds.union(*(names for names, _ in shared)), [*joined, each]))
    return [line for _, line in lines]


def drive_to_safe(
    outputs: Sequence[SafeOutput], sleep: Callable[[float], None] = time.sleep
) -> None:
    """Drive outputs to their safe values, the lines at the same time.

    Ends if all outputs of a line are final or set, and at most :data:`PATIENCE_S` after the ramp.

    Args:
        outputs: Those of all axes.
        sleep: Waits that many s.
    """
    ending = threading.Event()

    def drive(line: Sequence[SafeOutput]) -> None:
        give_up_s = max(each.give_up_s for each in line)

        def is_over() -> bool:
            settled = all(each.report.settled for each in line)
            return settled or ending.is_set() or line[0].clock() >= give_up_s

        drive_in_turn(line, is_over, sleep)

    lines = lines_of(outputs)
    if len(lines) == 1:
        drive(lines[0])
        return
    with ThreadPoolExecutor(len(lines), initializer=_same_priority()) as threads:
        try:
            for each in [threads.submit(drive, line) for line in lines]:
                each.result()
        finally:
            ending.set()  # Ctrl-C


def _same_priority() -> Callable[[], None]:
    """Return a function that gives a new thread the priority of this one; it starts without."""
    if not hasattr(os, "sched_getscheduler"):  # not Linux
        return lambda: None
    policy, parameters = os.sched_getscheduler(0), os.sched_getparam(0)

    def apply() -> None:
        with suppress(OSError):
            os.sched_setscheduler(0, policy, parameters)

    return apply


_WORST: tuple[OutputState, ...] = ("unknown", "sent", "set", "confirmed")


def joint_report(reports: Sequence[OutputReport], names: Sequence[str]) -> OutputReport:
    """Return the worst state of several outputs, with the names of those not confirmed.

    ``names`` are those of the axes; empty for the only one.
    """
    # First: a final state does not change any more.
    final = all(each.final for each in reports)
    worst = min((each.state for each in reports), key=_WORST.index)
    whys = []
    for report, name in zip(reports, names, strict=True):
        text = report.error if report.state == worst else describe(report.state, report.error)
        if report.state != "confirmed":
            whys.append(": ".join(filter(None, (name, text))))
    return OutputReport(worst, "; ".join(filter(None, whys)), final)


def _is_local(error: BaseException | None) -> bool:
    """Return whether an error is due to a lack of memory or descriptors in this process."""
    while error is not None:
        if isinstance(error, MemoryError):
            return True
        if isinstance(error, OSError) and error.errno in _OWN_ERRORS:
            return True
        error = error.__cause__ or error.__context__
    return False
