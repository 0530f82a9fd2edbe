"""Criteria for a harmless attack on a run, from the device's log."""

import json
import math

import numpy as np
import pytest

from hilctl.base.samples import COLUMNS, Flag, Samples
from tests.benchmark import other_reader
from tests.benchmark.attacked import RAMP_A_PER_S, START_A, DeviceLog
from tests.benchmark.kills import STAYS, Attack

PERIOD_S = 0.002


def log(tmp_path, currents_a, period_s=PERIOD_S):
    path = tmp_path / "log.jsonl"
    lines = [
        json.dumps({"monotonic_ns": round(k * period_s * 1e9), "current_a": current_a})
        for k, current_a in enumerate(currents_a)
    ]
    path.write_text("\n".join([*lines, '{"monotonic_ns": 9']), encoding="utf-8")
    return DeviceLog.read(path, PERIOD_S)


def ramp(start_a, period_s=PERIOD_S):
    steps = math.ceil(start_a / (RAMP_A_PER_S * period_s))
    return np.linspace(start_a, 0.0, steps + 1).tolist()


def samples(commands, unanswered=0):
    values = np.zeros((len(COLUMNS), len(commands)))
    values[list(COLUMNS).index("command")] = commands
    flags = np.zeros(len(commands), dtype=np.uint32)
    flags[len(commands) - unanswered :] = Flag.UNANSWERED
    return Samples.of(np.arange(len(commands)), values, flags)


def test_ramp_itself_is_not_counted(tmp_path):
    found = log(tmp_path, ramp(START_A))
    assert found.beyond_ramp_s(0) == pytest.approx(0.0, abs=PERIOD_S)
    assert found.largest_step(0) < 1.0


@pytest.mark.parametrize(("currents_a", "beyond_s"), [
    ([1.0] * 100 + ramp(1.0), 0.2),
    ([1.0, 0.0] + [1.0] * 98 + ramp(1.0), 0.2),
    ([1.0] * 100, math.inf),
])  # fmt: skip
def test_late_or_repeated_motion_is_detected(tmp_path, currents_a, beyond_s):
    """The output must stay at the safe value."""
    assert log(tmp_path, currents_a).beyond_ramp_s(0) == pytest.approx(beyond_s, abs=3 * PERIOD_S)


@pytest.mark.parametrize("before", [1, 50])
def test_jump_is_detected(tmp_path, before):
    """A step is detected even after a constant output."""
    found = log(tmp_path, [4.0] * before + [0.0])
    assert found.largest_step(0) == pytest.approx(4.0 / (RAMP_A_PER_S * (2 * PERIOD_S + 0.01)))


@pytest.mark.parametrize(("commands", "unanswered", "lost"), [
    ([3.0, 2.0, 1.0], 0, 0),
    ([3.0, 2.0], 0, 1),
    ([2.0, 1.0], 0, 0),
    ([3.0, 2.0, 1.0, 0.5], 1, 0),
    ([3.0, 2.0, 1.0, 0.5], 0, 1),
    ([3.0, 1.0], 0, 3),
])  # fmt: skip
def test_writes_that_are_not_recorded_are_counted(tmp_path, commands, unanswered, lost):
    """Opening may repeat the present output, and the last write is the safe value."""
    found = log(tmp_path, [3.0, 2.0, 1.0, 0.0])
    assert found.lost(samples(commands, unanswered), math.inf) == lost


@pytest.mark.parametrize(("late_s", "good"), [(0.0, True), (0.002, True), (0.1, False)])
def test_outputs_that_come_apart_are_detected(tmp_path, late_s, good):
    """One ramp begins later than the other."""
    one, other = (
        log(tmp_path, [START_A] * round(1 + wait_s / PERIOD_S) + ramp(START_A))
        for wait_s in (0.0, late_s)
    )
    assert (one.apart(other, 0) <= 1.0) == good


def test_without_a_recording_all_samples_are_lost(tmp_path):
    assert log(tmp_path, [START_A, START_A]).lost(None, math.inf) == 0
    assert log(tmp_path, [START_A, 2.0, 1.0]).lost(None, math.inf) == 2
    assert log(tmp_path, [START_A, 2.0, 1.0]).lost(None, 0.0) == 0


GOOD = {"lost": 0, "beyond_ramp_s": 0.1, "largest_step": 0.9, "reader": "", "hit": "kill loop"}
GOOD |= {"readable_s": 1.0, "is_false": False, "apart": 0.9}


@pytest.mark.parametrize("change", [
    {"lost": 1},
    {"beyond_ramp_s": 0.3},
    {"largest_step": 1.1},
    {"apart": 1.1},
    {"readable_s": 5.1},
    {"reader": other_reader.NOT_INSTALLED},
    {"is_false": True},
    {"hit": f"kill loop{STAYS}"},
])  # fmt: skip
def test_each_of_them_is_a_violation(change):
    assert Attack(phase="run", **GOOD).is_good(0.2, 1.0)
    assert not Attack(phase="run", **{**GOOD, **change}).is_good(0.2, 1.0)


def test_missing_reader_is_reported(monkeypatch, tmp_path):
    monkeypatch.setattr(other_reader, "PEERS", tmp_path)
    assert other_reader.verdict(tmp_path / "run.mcap", 1) == other_reader.NOT_INSTALLED
