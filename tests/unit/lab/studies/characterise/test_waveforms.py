"""Waveforms of the steps: within all limits, from rest to rest."""

import numpy as np
import pytest

from hilctl.experiment.load import load_experiment
from hilctl.experiment.preflight import check
from hilctl.lab.studies.characterise import waveforms as w

PIEZO = (
    "device={kind: simulated_piezo}",
    "limits={drive_v: [0.0, 100.0], slew_v_per_s: 5000.0, stroke_um: [-1.0, 38.0]}",
)
RESTING_HIGH = ("limits.peak_current_a=4.0", "safe={value: -2.0}")
BUDGET = ("limits.rms_current_a=0.8", "limits.thermal_time_constant_s=5.0")

WAVEFORMS = {
    "rest": w.at_rest,
    "sine": lambda x: w.sine(x, x.reach, x.middle_hz, 5.0),
    "multisine": lambda x: w.small_multisine(x, 0.05 * x.reach),
    "slow": lambda x: w.slow_loops(x, x.reach),
    "fast": lambda x: w.fast_loops(x, dict.fromkeys(w.frequencies_hz(x), x.reach)),
    "reversal": lambda x: w.reversal_curves(x, x.reach),
    "biased": lambda x: w.biased_loops(x, x.reach),
    "settled": lambda x: w.settled_loops(x, x.reach, np.array([x.low, x.high])),
    "random": lambda x: w.random_reference(x, x.reach, 1),
    "rests": lambda x: w.rests(x, x.reach),
    "small": lambda x: w.small_motions(x, x.reach),
}


@pytest.mark.slow
@pytest.mark.parametrize("settings", [(), PIEZO, RESTING_HIGH, BUDGET], ids=lambda s: s[:1])
@pytest.mark.parametrize("name", WAVEFORMS)
def test_every_step_may_start(experiment, limits_with, settings, name):
    """Every waveform passes the checks of a run."""
    base = [] if settings is not PIEZO else ["waveform.unit=V"]
    limits = limits_with(*settings, *base)
    keys, command = w.within(limits, WAVEFORMS[name](limits))
    checked = check(load_experiment(experiment, [*settings, f"waveform={w.json.dumps(keys)}"]))
    np.testing.assert_array_equal(checked.reference.values, command)
    step = 0.02 * (limits.high - limits.low)
    assert command[0] == pytest.approx(limits.rest, abs=step)
    assert command[-1] == pytest.approx(limits.rest, abs=step)


def test_the_multisine_has_whole_periods(limits):
    keys = w.small_multisine(limits, 0.2)
    period = limits.sample_rate_hz / keys["step_hz"]
    assert period == pytest.approx(round(period))
    assert keys["first_hz"] < 0.3 * limits.highest_hz < 2.0 * limits.highest_hz < keys["last_hz"]


def test_the_largest_of_the_slow_loops_comes_first(limits):
    amplitudes = [part["amplitude"] for part in w.slow_loops(limits, 2.0)["parts"]]
    assert amplitudes == [2.0, 1.5, 1.0, 0.5]


def test_settled_loops_are_spread_over_the_displacement(limits):
    """The displacement of this actuator is the square root of the command above the lowest."""
    line = np.linspace(0.0, 1.0, 201) ** 2
    loops = w.settled_loops(limits, 1.0, line)["parts"][1:]
    ends = np.array([(x["offset"] - x["amplitude"], x["offset"] + x["amplitude"]) for x in loops])
    low, high = np.sqrt(np.maximum(ends, 0.0)).T
    assert sorted(set(np.round(high - low, 2))) == [0.1, 0.25]
    assert (low.min(), high.max()) == pytest.approx((0.0, 1.0), abs=1e-3)


def test_reversal_curves_turn_ever_lower(limits):
    path = w.reversal_curves(limits, 2.0)["parts"][1]
    turns = path["levels"][3:-1:2]
    assert turns == sorted(turns, reverse=True)
    assert turns[-1] == -2.0
    assert set(path["levels"][:-1:2]) == {2.0}


@pytest.mark.parametrize("settings", [(), RESTING_HIGH], ids=["central", "high"])
def test_rests_are_long_and_lie_on_either_side(limits_with, settings):
    limits = limits_with(*settings)
    keys, command = w.within(limits, w.rests(limits, limits.reach))
    steps = keys["parts"][1]
    still = round((steps["dwell_s"] - steps["rise_s"]) * limits.sample_rate_hz) - 2
    dwell = round(steps["dwell_s"] * limits.sample_rate_hz)
    ends = command.size - dwell * np.arange(2, -1, -1)
    for end, side in zip(ends, (1.0, -1.0), strict=False):
        rest = command[end - still : end]
        assert np.ptp(rest) == 0.0
        assert rest[0] == pytest.approx(limits.centre + side * 0.8 * limits.reach, rel=0.01)
    assert command[-1] == pytest.approx(limits.rest)


def test_a_loop_keeps_the_amplitude_where_the_limits_allow_it(limits):
    keys, _ = w.within(limits, w.sine(limits, 2.0, 5.0, 4.0))
    assert keys["amplitude"] == 2.0
