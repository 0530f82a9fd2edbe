"""Lateness, the verdict, and the process that measures."""

import sys
from pathlib import Path

import numpy as np
import pytest

from hilctl.base.errors import InputError, RunError
from hilctl.loop.pacer import LateRules, Pacer
from hilctl.machine import timer_latency as module
from hilctl.machine.diagnosis import lateness_counts
from hilctl.machine.rt_setup import Realtime, SetUpStep
from hilctl.machine.timer_latency import Latency, measure, watch
from tests.fakes import FakeClock

MS = 1_000_000
STEPS = (SetUpStep("fifo", "refused", "SCHED_FIFO 80: Operation not permitted", "rtprio"),)


def latency(late_ns, rate_hz=1000.0):
    return Latency(rate_hz, np.array(late_ns, dtype=np.int64), STEPS)


@pytest.mark.parametrize(("late_ns", "longest_ns", "kept"), [
    ([0, 0, 0], 1 * MS, True),
    ([0, 1 * MS, 0], 2 * MS, True),
    ([0, 1 * MS + 1, 0], 2 * MS + 1, False),
    ([5 * MS, 5 * MS, 5 * MS], 1 * MS, True),
    ([3 * MS, 0, 0], 1 * MS, True),
])  # fmt: skip
def test_rate_is_kept_if_no_period_is_twice_the_nominal_one(late_ns, longest_ns, kept):
    found = latency(late_ns)
    assert found.longest_period_ns == longest_ns
    assert found.kept == kept


def test_highest_rate_that_would_be_kept():
    late_ns = [0, 4 * MS, 2 * MS, 0]
    rate_hz = latency(late_ns).kept_rate_hz
    assert rate_hz == pytest.approx(250.0)
    assert latency(late_ns, rate_hz).kept
    assert not latency(late_ns, rate_hz * 1.01).kept


def test_percentiles_are_in_us():
    figures = latency(np.arange(1001) * 1000).percentiles_us()
    assert figures == pytest.approx(
        {"p50": 500.0, "p90": 900.0, "p99": 990.0, "p99.9": 999.0, "max": 1000.0}
    )


def test_every_wake_up_is_counted_once():
    late_ns = np.array([-5, 0, 999, 1000, 1999, 2000, 3999, 4000, 10**12])
    counts = lateness_counts(late_ns)
    assert (counts[0], counts[1], counts[2], counts[4]) == (3, 2, 2, 1)
    assert sum(counts.values()) == late_ns.size
    assert lateness_counts(late_ns[:0]) == {}


@pytest.mark.parametrize(("policy", "expected"), [
    ("catch_up", [10, 2_500_000, 1_500_010, 500_020, 10]),
    ("skip", [10, 2_500_000, 10, 10, 10]),  # a stall counts once, as with cyclictest
])  # fmt: skip
def test_lateness_is_that_of_the_pacer(policy, expected):
    wanted = [10, 2_500_000, 10, 10, 10]
    clock, late_ns = FakeClock(stall_ns=dict(enumerate(wanted))), np.zeros(5, dtype=np.int64)
    watch(Pacer(clock, 1e6, policy, LateRules(1e6)), late_ns, clock, lambda: True)
    assert late_ns.tolist() == expected


def test_measuring_ends_with_the_parent():
    clock, late_ns = FakeClock(stall_ns=dict(enumerate([7] * 100))), np.zeros(100, dtype=np.int64)
    left = iter([True, True, False])
    watch(Pacer(clock, 1e6, "catch_up", LateRules(1e6)), late_ns, clock, lambda: next(left))
    assert np.count_nonzero(late_ns) == 3


def test_measuring_ends_if_it_is_far_behind():
    clock, late_ns = FakeClock(), np.zeros(1000, dtype=np.int64)
    clock.sleep_until_ns = lambda _: setattr(clock, "now", clock.now + 3_000_000)
    ticks = watch(Pacer(clock, 1e6, "catch_up", LateRules(1e6)), late_ns, clock, lambda: True)
    assert ticks < 300
    assert late_ns[ticks - 1] > 500_000_000 >= late_ns[ticks - 2]


@pytest.mark.parametrize("rate_hz", [0.0, -1.0, 20_001.0, float("nan")])
def test_rates_outside_the_range_are_refused(rate_hz):
    """A rate that Python alone could not keep is refused, not measured."""
    with pytest.raises(InputError, match="rate must be"):
        measure(rate_hz, 0.1, Realtime())


def test_latency_is_measured_in_a_subprocess():
    seen = []
    found = measure(500.0, 0.2, Realtime(), seen.append)
    assert found.late_ns.size == 100
    assert found.late_ns.min() >= 0
    assert [step.name for step in found.steps][-1] == "fifo"
    assert seen


def test_failure_of_the_subprocess_is_an_error(monkeypatch):
    monkeypatch.setattr(sys, "executable", "/bin/false")
    with pytest.raises(RunError, match="exit code 1"):
        measure(500.0, 0.1, Realtime())


def test_hanging_subprocess_is_ended(monkeypatch, tmp_path):
    stuck = tmp_path / "stuck"
    stuck.write_text("#!/bin/sh\nexec sleep 60\n")
    stuck.chmod(0o700)
    monkeypatch.setattr(sys, "executable", str(stuck))
    monkeypatch.setattr(module, "_PATIENCE_S", 0.0)
    with pytest.raises(RunError, match="end"):
        measure(500.0, 0.05, Realtime())


def test_exit_codes_of_doctor(monkeypatch, capsys):
    from typer.testing import CliRunner

    from hilctl.cli.commands import app
    from hilctl.machine import diagnosis

    experiment = Path(__file__).parents[3] / "configs" / "demo.yaml"
    asked = []

    def measured(rate_hz, seconds, settings, on_progress):
        asked.append((rate_hz, seconds, settings))
        return latency([0, 3 * MS, 0] if rate_hz > 500 else [0, 10, 0], rate_hz)

    monkeypatch.setattr(diagnosis, "measure", measured)
    runner = CliRunner()
    bad = runner.invoke(
        app, ["doctor", "--json", "--seconds", "2", "--experiment", str(experiment)]
    )
    good = runner.invoke(app, ["doctor", "--rate", "200"])
    assert (bad.exit_code, good.exit_code) == (1, 0)
    assert '"kept": false' in bad.stdout
    assert "yes, 200 Hz is kept" in good.stdout
    assert asked == [(1000.0, 2.0, Realtime()), (200.0, 10.0, Realtime())]
