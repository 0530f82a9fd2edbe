"""Limits of an experiment, and recordings of a formula as the actuator."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from hilctl.experiment.load import load_experiment
from hilctl.kernels.hysteresis import play_sum_shared, rest_memory
from hilctl.lab.studies.characterise.limits import limits_of
from hilctl.lab.studies.characterise.waveforms import reference_of, within


def plays(command, gain=1.0):
    """Return the displacement of two play operators, in um."""
    out = np.empty(command.size)
    thresholds, weights = np.array([0.3, 1.0]), np.array([4.0, 2.0]) * gain
    still = np.zeros(command.size)
    play_sum_shared(command, still, 3.0 * gain, thresholds, weights, rest_memory(2), out)
    return out


EXPERIMENT = """\
name: rig
device: {kind: simulated_terfenol, seed: 3}
sample_rate_hz: 5000
block: 50
waveform: {kind: hold, unit: A, level: 0.0, duration_s: 1.0}
compensator: none
limits: {peak_current_a: 4.0, slew_a_per_s: 5000.0, stroke_um: [-50.0, 50.0]}
"""


@pytest.fixture
def experiment(tmp_path) -> Path:
    path = tmp_path / "rig.yaml"
    path.write_text(EXPERIMENT, encoding="utf-8")
    return path


@pytest.fixture
def limits_with(experiment) -> Callable[..., object]:
    def make(*settings, highest_hz=None):
        return limits_of(load_experiment(experiment, settings), highest_hz)

    return make


@pytest.fixture
def limits(limits_with):
    return limits_with()


@pytest.fixture
def played(make_recording):
    """Return a function that records a waveform on an actuator function."""

    def play(limits, keys, actuator, noise_um=0.0, seed=1):
        keys, _ = within(limits, keys)
        reference = reference_of(limits, keys)
        command = reference.values.copy()
        noise = noise_um * np.random.default_rng(seed).standard_normal(command.size)
        return make_recording(
            actuator(command) + noise,
            command=command,
            segments=reference.segments,
            sample_rate_hz=limits.sample_rate_hz,
        )

    return play
