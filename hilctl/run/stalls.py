"""Retries of runs that a stall of the computer, the network or the device ended."""

import logging
from collections.abc import Callable
from typing import TypeVar

from hilctl.base.errors import RunError
from hilctl.recording.recording import Recording
from hilctl.run.result import RunResult

_log = logging.getLogger(__name__)

REPEATS = 2
_OF_STALLS = {"late", "device_lost", "sensor_invalid"}  # codes of events

_Made = TypeVar("_Made")


class StallError(RunError):
    """A stall ended or spoiled a run, which may be repeated."""


def fault_of(
    text: str, result: RunResult, recording: Recording, at_start: float | None
) -> RunError:
    """Return the fault of a run: a StallError if the run can be repeated, otherwise a RunError.

    The next run must know the output. It reads it from the device, except if ``at_start`` is set:
    then this run must have confirmed its safe value.
    """
    known = result.safe or at_start is None
    stalled = not _OF_STALLS.isdisjoint(event.code for event in recording.events)
    return StallError(text) if known and stalled else RunError(text)


def repeated(run: Callable[[], _Made]) -> _Made:
    """Return the result of a run; repeat the run up to REPEATS times if a stall ends it."""
    for number in range(1, REPEATS + 1):
        try:
            return run()
        except StallError as error:
            _log.warning("%s; the run is repeated (%d of %d)", error, number, REPEATS)
    return run()
