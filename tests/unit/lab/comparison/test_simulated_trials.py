"""Inverses before a simulated device, without a run's processes and files."""

import itertools
from pathlib import Path

import numpy as np
import pytest

from hilctl.base.errors import InputError
from hilctl.base.yaml import Document
from hilctl.experiment.load import load_experiment, resolve
from hilctl.lab.comparison import simulated_trials
from hilctl.lab.identify.data.records import SteadyLoop
from hilctl.models.plays import PpiModel
from hilctl.waveforms.spec import Chirp, Sine, Triangle
from tests.published import piezo_ppi

CONFIGS = Path(__file__).parents[4] / "configs"
TEXT = """
name: stage
device: {kind: simulated_piezo}
sample_rate_hz: 20000.0
block: 64
waveform: {kind: hold, unit: V, level: 0.0, duration_s: 0.1}
compensator: none
limits: {drive_v: [0.0, 100.0], slew_v_per_s: 1.0e+5, stroke_um: [-1.0, 45.0]}
"""
SINE = Sine(
    kind="sine", unit="um", amplitude=10.0, offset=18.0, frequency_hz=10.0, duration_s=0.5,
    soft_start_s=0.1, soft_end_s=0.1,
)  # fmt: skip
CHIRP = Chirp(kind="chirp", unit="um", amplitude=1.0, start_hz=1.0, stop_hz=10.0, duration_s=1.0)


def device(*waveforms, text=TEXT):
    return simulated_trials.TrialDevice(resolve(Document("stage.yaml", text), CONFIGS), waveforms)


def line(slope):
    return PpiModel(input_unit="V", direct=slope, weights=(), thresholds=())


def test_the_stage_follows_through_its_own_model():
    (trial,) = (rig := device(SINE)).run(piezo_ppi(), rig.references[0])
    assert trial.frequency_hz == pytest.approx(10.0)
    assert trial.peak_error_percent < 1.0
    assert trial.limited_samples == 0


def test_a_straight_line_leaves_the_hysteresis():
    (trial,) = (rig := device(SINE)).run(line(0.4), rig.references[0])
    assert trial.peak_hysteresis_percent > 5.0


def test_trials_start_from_rest():
    rig = device(SINE)
    first = rig.run(piezo_ppi(), rig.references[0])
    rig.run(line(0.3), rig.references[0])
    assert rig.run(piezo_ppi(), rig.references[0]) == first


def test_initial_ramp_is_not_evaluated():
    elsewhere = TEXT.replace("simulated_piezo", "simulated_piezo, output_at_open: 30.0")
    trials = [
        (rig := device(SINE, text=text)).run(piezo_ppi(), rig.references[0])[0]
        for text in (TEXT, elsewhere)
    ]
    assert trials[1].peak_error_percent == pytest.approx(trials[0].peak_error_percent, rel=0.1)


def test_the_limiter_is_between():
    (trial,) = (rig := device(SINE)).run(line(0.1), rig.references[0])
    assert trial.limited_samples > 100


def test_a_real_device_is_refused():
    loaded = load_experiment(CONFIGS / "modbus_labjack_t7.yaml")
    with pytest.raises(InputError, match="simulated device"):
        simulated_trials.TrialDevice(loaded, [SINE])


def test_what_does_not_repeat_is_refused():
    with pytest.raises(InputError, match="periodic"):
        device(CHIRP)


def test_waveforms_take_the_frequencies_asked_for():
    triangle = Triangle(
        kind="triangle", unit="um", amplitude=1.0, frequency_hz=1.0, duration_s=9.0,
        soft_start_s=0.3, soft_end_s=0.2,
    )  # fmt: skip
    for shape in (SINE, triangle):
        slow, fast = simulated_trials.waveforms_of(shape, [1.0, 200.0])
        soft_s = shape.soft_start_s + shape.soft_end_s
        assert (slow.frequency_hz, fast.frequency_hz) == (1.0, 200.0)
        assert fast.duration_s == pytest.approx(soft_s + simulated_trials.CYCLES / 200.0)
        assert fast.amplitude == shape.amplitude
    assert simulated_trials.waveforms_of(SINE, None) == [SINE]


def test_frequencies_need_a_shape_that_has_one():
    with pytest.raises(InputError, match="--frequencies"):
        simulated_trials.waveforms_of(CHIRP, [10.0])
    for wrong in (0.0, -1.0, float("nan"), float("inf")):
        with pytest.raises(InputError, match="must be > 0"):
            simulated_trials.waveforms_of(SINE, [wrong])


def test_the_stroke_is_that_of_the_widest_loop():
    wave = np.sin(2.0 * np.pi * np.arange(300) / 300)
    sine = simulated_trials.full_stroke(
        [SteadyLoop("sine", a * wave, 3.0 * a * wave + 2.0, 50.0) for a in (2, 6, 4)]
    )
    assert sine.offset == pytest.approx(2.0, abs=1e-2)
    assert sine.amplitude == pytest.approx(0.98 * 18.0, rel=1e-3)
    assert np.isclose(sine.frequency_hz, 50.0)


def test_the_shortest_round_counts():
    ticks = itertools.accumulate([0.0, 9e-3, 0.0, 2e-3, 0.0, 5e-3, 0.0, 4e-3, 0.0, 8e-3])
    command = 6.0 * np.sin(2.0 * np.pi * np.arange(300) / 300)
    loop = SteadyLoop("sine", command, 4.0 * command, 50.0)
    took = simulated_trials.inverse_ns(piezo_ppi(), loop, 50_000.0, lambda: next(ticks))
    assert took == pytest.approx(2e6 / simulated_trials.TIMED_SAMPLES)
