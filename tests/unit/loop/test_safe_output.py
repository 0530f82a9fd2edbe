"""The ramp of an output to the safe value, until the device confirms it."""

import errno
import os
import threading
from types import SimpleNamespace

import pytest

from hilctl.base.errors import DeviceError, UnconfirmedError
from hilctl.loop.safe_output import (
    PATIENCE_S,
    LocalError,
    OutputReport,
    SafeGoal,
    SafeOutput,
    describe,
    drive_in_turn,
    drive_to_safe,
    joint_report,
    lines_of,
)
from tests.fakes import FakeInfo


class Amplifier:
    """Takes a write in ``takes_s``; executes one older command at ``older``, if there is one."""

    def __init__(self, output=4.0, takes_s=0.0, older=None):
        self.now_s, self.output, self.takes_s, self.older = 100.0, output, takes_s, older
        self.writes, self.error, self.down_until_s = [], None, 0.0
        self.info = FakeInfo()

    def make_safe(self, value):
        self.sleep(self.takes_s)
        if self.now_s < self.down_until_s:
            raise DeviceError("no answer")
        if self.error:
            raise self.error
        self.output = value
        self.writes.append((self.now_s, value))

    def clock(self):
        return self.now_s

    def sleep(self, wait_s):
        self.now_s += wait_s
        if self.older and self.now_s >= self.older[0]:
            self.output, self.older = self.older[1], None


def driven(amplifier, until_s=1e3, *, start=4.0, pending=False, ramp_per_s=20.0):
    """Attempt until it is final, as a guardian does."""
    goal = SafeGoal(0.0, ramp_per_s, start, pending)
    output = SafeOutput(amplifier, goal, amplifier.clock(), amplifier.clock)
    drive_in_turn([output], lambda: amplifier.now_s >= until_s, amplifier.sleep, lambda: False)
    return output.report


@pytest.mark.parametrize("start", [4.0, -4.0])
@pytest.mark.parametrize("takes_s", [0.0, 0.001, 0.03])
def test_safe_value_is_approached_by_a_ramp(start, takes_s):
    amplifier = Amplifier(start, takes_s)
    output = driven(amplifier, start=start)
    times, values = zip(*amplifier.writes, strict=True)
    steps = [b - a for a, b in zip((start, *values), values, strict=False)]
    passed = [b - a for a, b in zip((times[0] - 0.005, *times), times, strict=False)]
    allowed = [20.0 * s + 1e-9 for s in passed]
    assert all(abs(step) <= most for step, most in zip(steps, allowed, strict=True))
    assert (output.state, values[-1], amplifier.output) == ("confirmed", 0.0, 0.0)
    assert times[-1] - times[0] == pytest.approx(0.2, abs=2 * takes_s + 0.006)


def test_a_device_slower_than_the_ramp_gets_the_safe_value():
    amplifier = Amplifier(takes_s=0.5)
    assert driven(amplifier).state == "confirmed"
    assert [value for _, value in amplifier.writes] == [pytest.approx(3.9), 0.0]


def test_without_a_last_command_there_is_no_ramp():
    amplifier = Amplifier()
    assert driven(amplifier, start=None).state == "confirmed"
    assert [value for _, value in amplifier.writes] == [0.0]


@pytest.mark.parametrize("down_s", [1.0, 8.0, 60.0, 3600.0])
def test_it_is_set_within_one_retry_of_the_return_of_the_device(down_s):
    amplifier = Amplifier()
    amplifier.down_until_s = amplifier.now_s + down_s
    driven(amplifier, until_s=amplifier.down_until_s + 2.0)
    (at_s, value), *_ = amplifier.writes
    assert value == 0.0
    assert at_s <= amplifier.down_until_s + (0.51 if down_s < 60.0 else 1.01)


@pytest.mark.parametrize("late_s", [0.1, 10.0, 34.0, 600.0])
def test_an_older_command_that_is_executed_late_is_corrected_within_one_repeat(late_s):
    amplifier = Amplifier(older=(100.0 + late_s, -4.0))
    output = driven(amplifier, until_s=101.1 + late_s, pending=True)
    assert (output.state, amplifier.older, amplifier.output) == ("set", None, 0.0)


def test_unanswered_ramp_value_may_be_executed_late():
    amplifier = Amplifier(older=(102.3, 3.0))
    amplifier.down_until_s = amplifier.now_s + 1.0
    output = driven(amplifier, until_s=103.0)
    assert (output.state, amplifier.older, amplifier.output) == ("set", None, 0.0)


def test_pending_command_prevents_confirmation():
    amplifier = Amplifier()
    output = driven(amplifier, until_s=1e4, start=None, pending=True)
    assert (output.state, output.final) == ("set", False)
    times = [at_s for at_s, _ in amplifier.writes]
    assert times[1] - times[0] < 0.5 < times[-1] - times[-2] < 1.5


def test_a_device_that_cannot_confirm_is_sent_the_value_several_times():
    amplifier = Amplifier()
    sent = []

    def make_safe(value):
        sent.append(value)
        raise UnconfirmedError("it does not answer")

    output = driven(SimpleNamespace(**vars(amplifier), make_safe=make_safe, clock=amplifier.clock,
                                    sleep=amplifier.sleep), start=None, pending=True)  # fmt: skip
    assert (output.state, output.final) == ("sent", True)
    assert sent == [0.0] * 5


@pytest.mark.parametrize("number", [errno.EMFILE, errno.ENFILE, errno.ENOMEM])
def test_exhausted_process_is_no_device_error(number):
    amplifier = Amplifier()
    amplifier.error = DeviceError("cannot connect")
    amplifier.error.__context__ = OSError(number, "none left")
    with pytest.raises(LocalError):
        driven(amplifier)


def test_driving_ends_when_waiting_gains_nothing():
    amplifier = Amplifier()
    goal = SafeGoal(0.0, 20.0, 4.0, pending=True)
    output = SafeOutput(amplifier, goal, amplifier.clock(), amplifier.clock)
    drive_to_safe([output], amplifier.sleep)
    assert output.report.state == "set"
    assert amplifier.now_s == pytest.approx(100.2, abs=0.02)


def test_driving_ends_after_its_time_limit():
    amplifier = Amplifier()
    amplifier.down_until_s = 1e9
    goal = SafeGoal(0.0, 20.0, 4.0, pending=True)
    output = SafeOutput(amplifier, goal, amplifier.clock(), amplifier.clock)
    drive_to_safe([output], amplifier.sleep)
    assert (output.report.state, output.report.error) == ("unknown", "no answer")
    assert amplifier.now_s == pytest.approx(100.2 + PATIENCE_S, abs=0.6)


def test_each_write_is_noted_before_it_is_sent():
    amplifier, noted = Amplifier(), []
    goal = SafeGoal(0.0, 20.0, 4.0, pending=False)
    output = SafeOutput(
        amplifier, goal, amplifier.clock(), amplifier.clock, lambda *note: noted.append(note)
    )
    amplifier.make_safe = lambda value: noted.append("sent")
    output.attempt()
    value = pytest.approx(3.9)
    assert noted == [(value, True), "sent", (value, False)]


def test_only_a_confirmed_output_is_called_confirmed():
    assert [state for state in ("confirmed", "set", "sent", "unknown")
            if "confirmed by" in describe(state)] == ["confirmed"]  # fmt: skip


NAMES = ["x", "y"]


def outputs_of(*amplifiers, start=4.0):
    """Return the outputs of several devices, on ramps from one start time."""
    goal = SafeGoal(0.0, 20.0, start, pending=False)
    return [SafeOutput(each, goal, amplifiers[0].clock(), each.clock) for each in amplifiers]


def test_outputs_of_one_line_ramp_in_turn():
    x, y = Amplifier(takes_s=0.001), Amplifier(takes_s=0.002)
    y.clock, y.sleep = x.clock, x.sleep
    outputs = outputs_of(x, y)
    drive_in_turn(outputs, lambda: False, x.sleep)
    assert joint_report([each.report for each in outputs], NAMES) == ("confirmed", "", True)
    pairs = [*zip(x.writes, y.writes, strict=False)]
    assert len(pairs) > 20
    # One ramp: they are as far apart as one write takes, and neither is left out.
    assert all(abs(one[1] - other[1]) <= 20.0 * 0.0081 for one, other in pairs)


def test_an_output_of_a_line_that_is_final_is_left_alone():
    x, y = Amplifier(), Amplifier()
    y.clock, y.sleep, y.error = x.clock, x.sleep, DeviceError("no answer")
    outputs = outputs_of(x, y)
    drive_in_turn(outputs, lambda: x.now_s > 130.0, x.sleep)
    assert [each.report.state for each in outputs] == ["confirmed", "unknown"]
    assert len([value for _, value in x.writes if value == 0.0]) == 1


def test_a_silent_device_does_not_delay_the_others():
    """Each line has a thread; the one that is silent is given up last."""
    silent = threading.Event()
    x, y = Amplifier(), Amplifier()
    y.clock, y.make_safe = x.clock, lambda value: silent.wait(30.0)
    outputs = outputs_of(x, y)
    make_safe = x.make_safe

    def answering(value):
        make_safe(value)
        if value == 0.0:
            silent.set()

    x.make_safe = answering
    drive_to_safe(outputs, x.sleep)
    assert silent.is_set()
    assert [each.report.state for each in outputs] == ["confirmed", "confirmed"]


@pytest.mark.parametrize(("holds", "lines"), [
    ([(), ()], ["x", "y"]),
    ([("a", "b"), ("c",)], ["x", "y"]),
    ([("a", "b"), ("b",)], ["xy"]),
    ([("a",), ("b",), ("a", "b")], ["xyz"]),
    ([("a",), ("b",), ("a",)], ["y", "xz"]),
])  # fmt: skip
def test_devices_that_share_a_resource_are_on_one_line(holds, lines):
    devices = [SimpleNamespace(info=FakeInfo(holds=each)) for each in holds]
    driven = [
        SimpleNamespace(device=each, name=name) for each, name in zip(devices, "xyz", strict=False)
    ]
    assert ["".join(each.name for each in line) for line in lines_of(driven)] == lines


@pytest.mark.parametrize(("states", "worst", "named"), [
    (["confirmed", "confirmed"], "confirmed", ""),
    (["confirmed", "unknown"], "unknown", "y"),
    (["set", "confirmed"], "set", "x"),
    (["sent", "set"], "sent", "xy"),
    (["unknown", "unknown"], "unknown", "xy"),
])  # fmt: skip
def test_several_outputs_are_as_safe_as_the_worst_of_them(states, worst, named):
    reports = [OutputReport(each, "", final=each == "confirmed") for each in states]
    joint = joint_report(reports, NAMES)
    assert (joint.state, joint.final) == (worst, named == "")
    assert {name for name in NAMES if name in joint.error.replace("may", "")} == {*named}


def test_threads_of_lines_have_the_priority_of_their_caller(monkeypatch):
    """A new thread starts with the ordinary one, and would be late on a busy machine."""
    applied = []
    monkeypatch.setattr(os, "sched_getscheduler", lambda process: os.SCHED_FIFO)
    monkeypatch.setattr(os, "sched_getparam", lambda process: os.sched_param(80))
    monkeypatch.setattr(
        os,
        "sched_setscheduler",
        lambda _, policy, parameters: applied.append((policy, parameters.sched_priority)),
    )
    x, y = Amplifier(), Amplifier()
    y.clock = x.clock
    drive_to_safe(outputs_of(x, y, start=0.0), x.sleep)
    assert {*applied} == {(os.SCHED_FIFO, 80)}
