"""From a checked experiment to a plan: late policy, late rules and a warm compensator."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from hilctl.run.assemble import assemble, axis_plan
from hilctl.run.start import checked_experiment

CONFIGS = Path(__file__).parents[3] / "configs"


def planned(loaded, state=None, *, paced=True):
    values = np.zeros(100)
    return assemble(loaded, [axis_plan(loaded, values, values, state)], paced=paced)


def loaded_of(*settings, name="demo.yaml", **info):
    loaded = checked_experiment(CONFIGS / name, list(settings)).loaded
    return replace(loaded, device=SimpleNamespace(info=replace(loaded.device.info, **info)))


@pytest.mark.parametrize(
    ("info", "policy"),
    [({}, "skip"), ({"buffered": True}, "catch_up"), ({"latency_blocks": 3}, "follow")],
)
def test_the_device_determines_what_late_ticks_do(info, policy):
    plan = planned(loaded_of(**{"buffered": False, "latency_blocks": 0, **info}))
    assert plan.late_policy == policy
    assert plan.start_policy == ("spaced" if policy == "skip" else policy)


def test_a_run_without_a_pace_misses_nothing():
    assert planned(loaded_of(), paced=False).late_rules.max_missed == np.inf


def test_compensator_starts_from_the_given_state():
    loaded = loaded_of(name="terfenol_sine_6a.yaml")
    rest = planned(loaded).axes[0].compensator
    state = rest.state()
    state[0] += 0.25
    np.testing.assert_array_equal(planned(loaded, state).axes[0].compensator.state(), state)
    np.testing.assert_array_equal(planned(loaded).axes[0].compensator.state(), rest.state())
