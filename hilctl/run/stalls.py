"""Repeats of runs that a stall of the machine, the network or the device ended."""

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
    """Return the fault of a run: a StallError if another run can tell where the output is.

    The next run reads the output, unless the device cannot tell it: then ``at_start`` is set, and
    this run must have confirmed that its output is safe.
    """
    known = result.safe or at_start is None
    stalled = not _OF_STALLS.isdisjoint(event.code for event in recording.events)
    return StallError(text) if known and stalled else RunError(text)


def repeated(run: Callable[[], _Made]) -> _Made:
    """Return the result of a run, which is repeated if a stall ends it."""
    for number in range(1, REPEATS + 1):
        try:
            return run()
        except StallError as error:
            _log.warning("%s; it is repeated (%d of %d)", error, number, REPEATS)
    return run()
