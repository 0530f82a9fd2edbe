"""Repeats of runs: only after a stall, and only if the output is known."""

from pathlib import Path
from types import SimpleNamespace

import pytest

from hilctl.base.errors import RunError
from hilctl.run.result import RunResult
from hilctl.run.stalls import REPEATS, StallError, fault_of, repeated


@pytest.mark.parametrize(("code", "safe", "at_start", "stall"), [
    ("late", "confirmed", 0.0, True),
    ("device_lost", "unconfirmed", None, True),
    ("sensor_invalid", "confirmed", 0.0, True),
    ("late", "unconfirmed", 0.0, False),
    ("stroke", "confirmed", None, False),
])  # fmt: skip
def test_faults(code, safe, at_start, stall):
    recording = SimpleNamespace(events=(SimpleNamespace(code=code),))
    result = RunResult(Path("run.mcap"), "fault", "by a test", safe, 0, 0, 0, 0)
    assert isinstance(fault_of("text", result, recording, at_start), StallError) == stall


@pytest.mark.parametrize("stalls", [0, REPEATS, REPEATS + 1])
def test_a_run_is_repeated_a_few_times(stalls):
    left = iter([StallError("by a test")] * stalls)

    def run():
        if error := next(left, None):
            raise error
        return "done"

    if stalls > REPEATS:
        with pytest.raises(StallError):
            repeated(run)
    else:
        assert repeated(run) == "done"


def test_other_faults_are_not_repeated():
    called = []

    def run():
        called.append(1)
        raise RunError("by a test")

    with pytest.raises(RunError):
        repeated(run)
    assert len(called) == 1
