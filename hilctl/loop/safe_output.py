"""The safe value: repeated writes until the device confirms it, and the outcome of a run.

The loop, the guardian, the supervisor and ``hilctl safe`` use this module. A device performs single
writes (:meth:`hilctl.base.device.Device.make_safe`) and never retries.
"""

import errno
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Literal, TypeAlias, cast

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


class SafeOutput:
    """Drive one device to its safe value; call :meth:`attempt` until :attr:`final`.

    The ramp is a function of time, so a slow device gets fewer and larger steps.

    Args:
        device: Open or not.
        goal: The safe value and the ramp to it.
        clock: Monotonic time in s.
        on_write: Called with each value before it is written.

    Attributes:
        state: State of the output.
        error: Why it is not confirmed; empty if the last write succeeded.
    """

    def __init__(
        self,
        device: Device,
        goal: SafeGoal,
        clock: Callable[[], float] = time.monotonic,
        on_write: Callable[[float], None] = lambda value: None,
    ) -> None:
        self._device, self._goal = device, goal
        if device.info.digital_output:
            # Not with the first write, because the safe ramp must not wait for it.
            cast(DigitalDevice, device).safe_command = goal.value
        self._clock, self._on_write = clock, on_write
        self.pending = goal.pending
        """Whether an older command without an answer may still be executed."""
        self._began_s: float | None = None
        self._sends = 0
        self.pause_s = 0.0
        """Pause before the next attempt, s."""
        self.state: OutputState = "unknown"
        self.error = "nothing was sent"

    @property
    def final(self) -> bool:
        """Whether further writes cannot change the state."""
        return self.state == "confirmed" or (self.state == "sent" and self._sends >= _SENDS)

    def attempt(self) -> None:
        """Write once; update state, error and pause.

        Raise LocalError if this process lacks memory or descriptors.
        """
        now_s = self._clock()
        if self._began_s is None:
            self._began_s = now_s - _RAMP_S
        passed_s = now_s - self._began_s
        value, least_s = (
            self._value(passed_s),
            PATIENT_PAUSE_S if passed_s > PATIENT_AFTER_S else 0.0,
        )
        confirmed = True
        self._on_write(value)
        try:
            self._device.make_safe(value)
        except UnconfirmedError:
            confirmed = False
        except DeviceError as error:
            if _is_local(error):
                raise LocalError(str(error)) from error
            self.state, self.error = "unknown", str(error)
            self.pause_s = _RETRY_S if passed_s <= PATIENCE_S else max(_LATER_RETRY_S, least_s)
            # The device may execute this command later, after the next one.
            self.pending |= value != self._goal.value
            return
        if value != self._goal.value:
            self.state, self.error, self.pause_s = "unknown", "on the safe ramp", _RAMP_S
            return
        self.error, self.pause_s = "", max(_REPEAT_S, least_s)
        if confirmed:
            self.state = "set" if self.pending else "confirmed"
        else:
            self._sends += 1
            self.state = "sent"

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
    """Write until the state is final or set, at most :data:`PATIENCE_S` longer than the ramp.

    Args:
        device: Open or not.
        goal: The safe value and the ramp to it.
        clock: Monotonic time in s.
        sleep: Waits that many s.
        on_write: Called with each value before it is written.
    """
    output = SafeOutput(device, goal, clock, on_write)
    ramp_s = 0.0 if goal.start is None else abs(goal.start - goal.value) / goal.ramp_per_s
    give_up_s = clock() + ramp_s + PATIENCE_S
    while True:
        try:
            output.attempt()
        except LocalError as error:
            output.error, output.pause_s = str(error), _RETRY_S
        # The guardian watches a value that is set but not confirmed.
        if output.final or output.state == "set" or clock() >= give_up_s:
            return output
        sleep(output.pause_s)


_WORST: tuple[OutputState, ...] = ("unknown", "sent", "set", "confirmed")


def joint_state(outputs: Sequence[SafeOutput], names: Sequence[str]) -> tuple[OutputState, str]:
    """Return the worst state of several outputs, and why those outputs are not confirmed."""
    state = min((each.state for each in outputs), key=_WORST.index)
    whys = [
        f"{name}: {each.error}" if name and each.error else each.error
        for each, name in zip(outputs, names, strict=True)
        if each.state == state
    ]
    return state, "; ".join(filter(None, whys))


def drive_all_to_safe(
    devices: Sequence[Device],
    goals: Sequence[SafeGoal],
    clock: Callable[[], float],
    sleep: Callable[[float], None],
    on_writes: Sequence[Callable[[float], None]],
) -> list[SafeOutput]:
    """Drive each device to its safe value; none waits for the timeouts of another one.

    See :func:`drive_to_safe` for the arguments; sequences have one item per device.
    """
    outputs = list(zip(devices, goals, on_writes, strict=True))
    if len(outputs) == 1:
        device, goal, on_write = outputs[0]
        return [drive_to_safe(device, goal, clock, sleep, on_write)]
    with ThreadPoolExecutor(len(outputs)) as threads:
        started = [
            threads.submit(drive_to_safe, device, goal, clock, sleep, on_write)
            for device, goal, on_write in outputs
        ]
        return [each.result() for each in started]


def _is_local(error: BaseException | None) -> bool:
    """Return whether an error is due to a lack of memory or descriptors in this process."""
    while error is not None:
        if isinstance(error, MemoryError):
            return True
        if isinstance(error, OSError) and error.errno in _OWN_ERRORS:
            return True
        error = error.__cause__ or error.__context__
    return False
