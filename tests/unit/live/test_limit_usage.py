"""Use of each limit."""

import math

import numpy as np
import pytest

from hilctl.live.limit_usage import Gauge, Headroom
from hilctl.run.metadata import RunDescription
from hilctl.run.start import checked_experiment
from tests.unit.live.conftest import CONFIGS, traces

LIMITS = {"rms_current_a": 5, "thermal_time_constant_s": 10, "tracking_error_um": 8}


@pytest.fixture(scope="module")
def description():
    settings = [f"limits.{key}={value}" for key, value in LIMITS.items()]
    return RunDescription.of(checked_experiment(CONFIGS / "demo.yaml", settings))


def used(headroom, late_s=0.0):
    return {gauge.name: gauge.used for gauge in headroom.gauges(late_s)}


def test_use_of_each_limit(description):
    headroom = Headroom(description)
    headroom.add(traces(0, command=[0.0, 0.1], displacement=[0.0, 26.25], error=[1.0, -4.0]))
    headroom.add(traces(2, command=[0.3], displacement=[0.0], error=[0.0]))
    found = used(headroom, 0.25)
    assert found["command"] == pytest.approx(0.3 / 7.07)
    assert found["slew"] == pytest.approx(0.2 * 50000 / 20000)  # from one look to the next
    assert found["displacement"] == pytest.approx((26.25 + 7.5) / 67.5)
    assert found["tracking error"] == 0.5
    assert found["late tick"] == 0.25
    assert "measured - command" not in found


def test_peak_is_held_for_a_second(description):
    headroom = Headroom(description)
    headroom.add(traces(0, command=[7.07]))
    headroom.add(traces(30_000, command=[1.0]))
    assert used(headroom)["command"] == 1.0
    headroom.add(traces(60_000, command=[1.0]))
    assert used(headroom)["command"] == pytest.approx(1.0 / 7.07)


def test_coil_heat_agrees_with_the_interlock(description):
    headroom = Headroom(description)
    for start in range(0, 500_000, 50_000):  # one time constant
        headroom.add(traces(start, command=np.full(50_000, 5.0)))
    assert used(headroom)["coil heat"] == pytest.approx(math.sqrt(1 - math.exp(-1)), rel=1e-6)


@pytest.mark.parametrize(("part", "level"), [(0.5, "info"), (0.81, "warning"), (0.96, "error")])
def test_level_of_a_gauge(part, level):
    assert Gauge("slew", part, part, 1.0, "A/s").level == level
