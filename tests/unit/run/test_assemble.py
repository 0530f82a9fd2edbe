"""From a checked experiment to a plan: late policy, late rules and a warm compensator."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import Mock

import numpy as np
import pytest

from hilctl.base.device import DeviceInfo
from hilctl.base.errors import DeviceError, InputError
from hilctl.run.assemble import assemble, starting_output
from hilctl.run.start import checked_experiment

CONFIGS = Path(__file__).parents[3] / "configs"


def planned(loaded, state=None, *, paced=True):
    values = np.zeros(100)
    return assemble(loaded, values, values, state, paced=paced)


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


def test_late_rules_are_in_the_file_s_own_ticks():
    """Half a tick of 50 samples at 50 kHz is half a millisecond; no run of late ticks lasts 2 s."""
    rules = planned(loaded_of("timing.late_after=0.5", "timing.max_late_s=0.25")).late_rules
    assert (rules.late_after_ns, rules.max_late_ns) == (pytest.approx(5e5), pytest.approx(2.5e8))
    assert rules.max_consecutive_late == 2000


@pytest.mark.parametrize(("settings", "samples", "expected"), [
    ([], 10**6, (10_000, 100.0)),
    ([], 50 * 300, (300, 3.0)),
    (["timing.max_missed_share=0.2"], 10**6, (10_000, 2000.0)),
    (["timing.on_misses=warn"], 10**6, (10_000, np.inf)),
])  # fmt: skip
def test_misses_are_counted_over_ten_seconds_or_the_whole_run(settings, samples, expected):
    loaded, values = loaded_of(*settings), np.zeros(samples)
    rules = assemble(loaded, values, values, None).late_rules
    assert (rules.missed_window, rules.max_missed) == expected


def test_a_run_without_a_pace_misses_nothing():
    assert planned(loaded_of(), paced=False).late_rules.max_missed == np.inf


def test_the_compensator_starts_from_the_memory_that_was_given():
    loaded = loaded_of(name="terfenol_sine_6a.yaml")
    rest = planned(loaded).axes[0].compensator
    state = rest.state()
    state[0] += 0.25
    np.testing.assert_array_equal(planned(loaded, state).axes[0].compensator.state(), state)
    np.testing.assert_array_equal(planned(loaded).axes[0].compensator.state(), rest.state())


INFO = DeviceInfo("rig", "a rig", "A", -10.0, 10.0, -75.0, 75.0, 1e3)


def device(output):
    return SimpleNamespace(info=INFO, output=lambda: output)


@pytest.mark.parametrize("output", [-10.0, -7.0, 0.0, 10.0])
@pytest.mark.parametrize("at_start", [None, 3.0])
def test_what_the_device_says_goes_first(output, at_start):
    assert starting_output(device(output), at_start) == output


def test_what_is_vouched_for_stands_in_for_what_is_not_known():
    assert starting_output(device(None), 3.0) == 3.0


def test_an_unknown_output_is_refused_by_the_key_that_would_say_it():
    with pytest.raises(InputError) as caught:
        starting_output(device(None), None)
    assert str(caught.value).startswith("safe.at_start is required: rig")
    assert str(caught.value).endswith("in A; nothing has moved")


@pytest.mark.parametrize("output", [10.1, -10.1, float("nan"), float("inf")])
def test_an_output_that_no_command_gives_is_refused(output):
    with pytest.raises(InputError, match=r"rig: .* -10 to 10 A"):
        starting_output(device(output), None)


@pytest.mark.parametrize("output", [10.00001, -10.00001])
def test_a_rounded_end_of_the_range_is_the_end(output):
    """A command beyond it would be refused by the device."""
    assert starting_output(device(output), None) == pytest.approx(output)
    assert abs(starting_output(device(output), None)) == 10.0


def test_a_device_that_does_not_answer_is_no_refusal():
    with pytest.raises(DeviceError, match="no answer"):
        starting_output(
            SimpleNamespace(info=INFO, output=Mock(side_effect=DeviceError("no answer"))), 0.0
        )
