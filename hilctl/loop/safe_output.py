"""Bring an output to its safe value, one write after another, until the device confirms it.

The loop, the guardian, the supervisor and ``hilctl safe`` all use this; a device does single
writes (:meth:`hilctl.base.device.Device.make_safe`) and never retries.
"""

import errno
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, TypeAlias

from hilctl.base.device import Device
from hilctl.base.errors import DeviceError, UnconfirmedError

OutputState: TypeAlias = Literal["confirmed", "set", "sent", "unknown"]
"""What is known of the output at the end of a run.

``confirmed``: the device confirmed the safe value, and no older command can follow.
``set``: the device confirmed the safe value, but an older command, which was sent and never
answered, may still be executed.
``sent``: the safe value was sent to a device that has no way to confirm it.
``unknown``: the safe value is not confirmed.
"""

HOLD_S = 30.0
"""How long the safe value is repeated if an older command was never answered.

A gateway queues requests, and its own time-outs and retries add up; devices and gateways that took
10 s for one request have been seen.
"""
PATIENCE_S = 5.0
"""How long a command waits for the confirmation before it returns and leaves the rest to the
guardian."""
_RAMP_S = 0.005
_RETRY_S = 0.05
_LATER_RETRY_S = 0.5
_REPEAT_S = 0.2
_SENDS = 5
_OWN_ERRORS = {errno.EMFILE, errno.ENFILE, errno.ENOMEM, errno.ENOBUFS}


_DESCRIPTIONS: dict[OutputState, str] = {
    "confirmed": "the output is at its safe value, confirmed by the device",
    "set": "the safe value is set, but not yet confirmed to hold: "
    "an older command that was never answered may still be executed",
    "sent": "the safe value was sent, but this device cannot confirm it",
    "unknown": "the safe value could not be confirmed",
}


def describe(state: OutputState, error: str = "") -> str:
    """Return what is known of the output, for people.

    Args:
        state: What is known.
        error: Why it is not confirmed; may be empty.
    """
    return f"{_DESCRIPTIONS[state]}: {error}" if error else _DESCRIPTIONS[state]


class LocalError(Exception):
    """This process cannot drive the device, for lack of memory or descriptors; another one may."""


@dataclass(frozen=True, slots=True)
class SafeGoal:
    """Where the output goes, and how.

    Attributes:
        value: The safe value, in the device's command unit.
        ramp_per_s: Fastest change on the way, > 0.
        start: Last command; None if it is not known, then there is no ramp.
        pending: Whether a command that was sent and never answered may still be executed.
    """

    value: float
    ramp_per_s: float
    start: float | None
    pending: bool


class SafeOutput:
    """Drives one device to its safe value; the caller repeats :meth:`attempt` until it is final.

    The ramp goes by time: each write is as far on the way as the time since the first one allows,
    so a device that is too slow for a ramp, or does not answer for a while, gets fewer and larger
    steps.

    Args:
        device: Open or not.
        goal: Where the output goes.
        clock: Monotonic time in s.
        on_write: Called with each value before it is written.

    Attributes:
        state: What is known of the output.
        error: Why it is not confirmed; empty if no write failed since.
    """

    def __init__(
        self,
        device: Device,
        goal: SafeGoal,
        clock: Callable[[], float] = time.monotonic,
        on_write: Callable[[float], None] = lambda value: None,
    ) -> None:
        self._device, self._goal = device, goal
        self._clock, self._on_write = clock, on_write
        self._pending = goal.pending
        self._began_s: float | None = None
        self._held_since_s: float | None = None
        self._sends = 0
        self.pause_s = 0.0
        """How long to wait before the next attempt, s."""
        self.state: OutputState = "unknown"
        self.error = "nothing was sent"

    @property
    def final(self) -> bool:
        """Whether no further write can tell more."""
        return self.state == "confirmed" or (self.state == "sent" and self._sends >= _SENDS)

    def attempt(self) -> None:
        """Write once, and update state, error and pause.

        Raises:
            LocalError: This process lacks memory or descriptors.
        """
        now_s = self._clock()
        if self._began_s is None:
            self._began_s = now_s - _RAMP_S
        value = self._value(now_s - self._began_s)
        confirmed = True
        self._on_write(value)
        try:
            self._device.make_safe(value)
        except UnconfirmedError:
            confirmed = False
        except DeviceError as error:
            if _is_local(error):
                raise LocalError(str(error)) from error
            patient = now_s - self._began_s > PATIENCE_S
            self.pause_s = _LATER_RETRY_S if patient else _RETRY_S
            self.state, self.error = "unknown", str(error)
            # A device that was silent until now may find older commands beside the next one, this
            # value of the ramp too.
            self._held_since_s = None
            self._pending |= value != self._goal.value
            return
        if value != self._goal.value:
            self.state, self.error, self.pause_s = "unknown", "on the safe ramp", _RAMP_S
            return
        self.error, self.pause_s = "", _REPEAT_S
        if confirmed:
            self.state = self._held()
        else:
            self._sends += 1
            self.state = "sent"

    def _held(self) -> OutputState:
        now_s = self._clock()
        if self._held_since_s is None:
            self._held_since_s = now_s
        held = now_s - self._held_since_s >= HOLD_S
        return "confirmed" if held or not self._pending else "set"

    def _value(self, passed_s: float) -> float:
        goal = self._goal
        if goal.start is None:
            return goal.value
        step = goal.ramp_per_s * passed_s
        if goal.start > goal.value:
            return max(goal.value, goal.start - step)
        return min(goal.value, goal.start + step)


def drive_to_safe(
    device: Device,
    goal: SafeGoal,
    clock: Callable[[], float] = time.monotonic,
    sleep: Callable[[float], None] = time.sleep,
    on_write: Callable[[float], None] = lambda value: None,
) -> SafeOutput:
    """Write until the outcome is final, or no more can be known within :data:`PATIENCE_S`.

    Args:
        device: Open or not.
        goal: Where the output goes.
        clock: Monotonic time in s.
        sleep: Waits that many s.
        on_write: Called with each value before it is written.

    Returns:
        What is known of the output.
    """
    output = SafeOutput(device, goal, clock, on_write)
    ramp_s = 0.0 if goal.start is None else abs(goal.start - goal.value) / goal.ramp_per_s
    give_up_s = clock() + ramp_s + PATIENCE_S
    while True:
        try:
            output.attempt()
        except LocalError as error:
            output.error, output.pause_s = str(error), _RETRY_S
        # Nothing is gained here by watching a value that is set: the guardian does.
        if output.final or output.state == "set" or clock() >= give_up_s:
            return output
        sleep(output.pause_s)


def _is_local(error: BaseException | None) -> bool:
    """Return whether an error comes from a lack of memory or descriptors in this process."""
    while error is not None:
        if isinstance(error, MemoryError):
            return True
        if isinstance(error, OSError) and error.errno in _OWN_ERRORS:
            return True
        error = error.__cause__ or error.__context__
    return False
