"""Learning over runs that a test makes: what stops it, and what then stands."""

from pathlib import Path

import numpy as np
import pytest

from hilctl.base.errors import ConfigError, InputError, RunError
from hilctl.experiment.correction import load_correction
from hilctl.ilc.ilc_session import HIGHEST_PART, IlcSession, beginning, repeating
from hilctl.run.result import RunResult
from hilctl.run.start import checked_experiment, unpaced

SINE = Path(__file__).parents[3] / "configs" / "terfenol_sine_6a.yaml"
SETTINGS = ["waveform.frequency_hz=250", "waveform.duration_s=0.4681", "device.seed=40"]


class Runs:
    """Runs for real up to one that ends otherwise; keeps what each was set to."""

    def __init__(self, last=99, code="fault", stop_signal=0):
        self.last, self.code, self.stop_signal = last, code, stop_signal
        self.settings = []

    def __call__(self, path, settings, output):
        self.settings.append(settings)
        if len(self.settings) <= self.last:
            return unpaced(path, settings, output)
        return RunResult(output, self.code, "by a test", "confirmed", self.stop_signal, 0, 0, 0)


def learned(folder, runs, cycles=2):
    return IlcSession(SINE, SETTINGS, folder, runs).learn(cycles, lambda rows: None)


@pytest.mark.slow
def test_each_run_has_the_next_correction_and_noise_of_its_own(tmp_path):
    runs, folder = Runs(), tmp_path / "lab #3: ü"  # of a name that has a meaning in YAML
    found = learned(folder, runs)
    assert len(runs.settings) == 4
    for number, settings in enumerate(runs.settings):
        file = folder / f"run-{number:02d}.yaml"
        assert settings[-2:] == [f'compensator.correction="{file}"', f"device.seed={40 + number}"]
        assert load_correction(file).sample_rate_hz == found.correction.sample_rate_hz
    assert [row.run for row in found.rows] == [0, 1, 2]
    assert [row.run for row in found.check] == [3]
    assert found.reason.startswith("2 learning")
    assert found.rows[1].error_percent < found.rows[0].error_percent


def test_a_run_that_is_stopped_leaves_what_was_learned(tmp_path):
    found = learned(tmp_path, Runs(1, "stopped", 15))
    assert (found.stop_signal, found.fault, found.check) == (15, False, ())
    assert len(found.rows) == 1
    assert "run 1: " in found.reason


def test_a_fault_is_one_and_leaves_what_was_learned(tmp_path):
    found = learned(tmp_path, Runs(1))
    assert (found.stop_signal, found.fault) == (0, True)


def test_a_first_run_that_fails_is_an_error(tmp_path):
    with pytest.raises(RunError, match="run 0: "):
        learned(tmp_path, Runs(0))


def test_a_folder_that_can_not_be_made_is_said_before_a_run(tmp_path):
    (tmp_path / "file").touch()
    runs = Runs()
    with pytest.raises(InputError, match="cannot create"):
        learned(tmp_path / "file" / "runs", runs)
    assert runs.settings == []


CONFIGS = Path(__file__).parents[3] / "configs"
SINE_repeating = CONFIGS / "terfenol_sine_6a.yaml"


def test_a_sine_is_learned_from_nothing():
    checked = checked_experiment(SINE_repeating, [])
    (segment,) = repeating(checked)
    state = beginning(checked, segment)
    assert state.highest_hz == HIGHEST_PART * checked.reference.sample_rate_hz
    assert not np.any(state.next_um)


def test_without_a_compensator_there_is_no_input_to_correct():
    checked = checked_experiment(CONFIGS / "terfenol_sine_6a_uncompensated.yaml", [])
    with pytest.raises(ConfigError, match="compensator: "):
        repeating(checked)


def test_a_single_cycle_does_not_repeat():
    short = ["waveform.frequency_hz=10", "waveform.duration_s=0.5"]
    with pytest.raises(ConfigError, match="2 whole cycles"):
        repeating(checked_experiment(SINE_repeating, short))
