"""Learning over runs that a test makes: what stops it, and what then stands."""

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from hilctl.analysis.report import summarize
from hilctl.base.errors import ConfigError, RunError
from hilctl.base.segments import Segment
from hilctl.experiment.sections.correction import (
    Correction,
    LearnedCycle,
    load_correction,
    signature,
    write_correction,
)
from hilctl.lab.ilc.cycle import CycleScore
from hilctl.lab.ilc.residual import ResidualBand
from hilctl.lab.ilc.update import IlcState
from hilctl.lab.studies.learn import (
    HIGHEST_PART,
    IlcResult,
    IlcSession,
    Learner,
    beginning,
    correction_setting,
    learners_of,
    repeating,
    row_of,
)
from hilctl.lab.studies.study import StudyHost, run_study
from hilctl.models.model_file import model_sha256
from hilctl.recording.reader import read
from hilctl.run.start import checked_experiment, checked_run, unpaced

SINE = Path(__file__).parents[4] / "configs" / "terfenol_sine_6a.yaml"
SETTINGS = ["waveform.frequency_hz=250", "waveform.duration_s=0.4681", "device.seed=40"]


class Runs:
    """Runs for real up to one that ends otherwise; keeps what each was set to."""

    def __init__(self, last=99, code="fault", stop_signal=0):
        self.last, self.code, self.stop_signal = last, code, stop_signal
        self.settings = []

    def __call__(self, path, settings, output, *_, **__):
        self.settings.append(settings)
        result = unpaced(path, settings, output)
        if len(self.settings) <= self.last:
            return result
        return replace(result, code=self.code, reason="by a test", stop_signal=self.stop_signal)


def learned(folder, runs, cycles=2, settings=SETTINGS):
    session, host = IlcSession(SINE, settings, folder), StudyHost(run=runs, real_time=False)
    return run_study(session.study(cycles, lambda rows: None), folder, host, resume=False)


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
    assert "2 learning cycles" in found.reason
    assert found.rows[1].error_percent < found.rows[0].error_percent
    (label,) = found.correction.residual
    bands = found.residual["", label]
    assert {band.cause for band in bands} == {"unfinished"}
    assert found.correction.residual[label] == "; ".join(map(str, bands))


@pytest.mark.parametrize("before", [
    "condition={cycles: 3, frequency_hz: 50, rest_s: 0.0123}",
    "compensator.offset=measured",
    "device.output_at_open=3.3",
])  # fmt: skip
def test_samples_before_the_waveform_are_not_evaluated(tmp_path, before):
    (row,) = learned(tmp_path, Runs(1), 1, [*SETTINGS, before]).rows
    report = summarize(read(Path(row.recording)))
    assert row.error_percent == pytest.approx(report.peak_error_percent)


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


CONFIGS = Path(__file__).parents[4] / "configs"
SINE_repeating = CONFIGS / "terfenol_sine_6a.yaml"


def test_a_sine_is_learned_from_nothing():
    checked = checked_experiment(SINE_repeating, [])
    (segment,) = repeating(checked)
    state = beginning(Learner(checked, segment))
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


RATE_HZ = 10_000.0
SEGMENT = Segment("sine", 0, 5000, 0, 5000, 100.0)
ERROR = CycleScore(
    harmonics_um=np.zeros(4, dtype=complex), noise_um=np.zeros(4), step_hz=100.0, cycles=16,
    peak_um=2.0, rms_um=0.5, peak_to_peak_um=50.0, floor_um=0.1, strongest_hz=100.0,
    answer=1.0 + 0.0j,
)  # fmt: skip
STATE = IlcState(RATE_HZ, 1250.0, np.zeros(4, dtype=complex))
LEARNER = SimpleNamespace(segment=SEGMENT, axis="x")
ROW = row_of(3, LEARNER, ERROR, STATE, 800.0, Path("run-03.mcap"), 0.2)


def test_a_row_is_in_percent_of_the_peak_to_peak_displacement():
    assert (ROW.run, ROW.label, ROW.cycles, ROW.recording) == (3, "sine", 16, "run-03.mcap")
    assert (ROW.axis, ROW.contour_percent) == ("x", 0.2)
    assert ROW.rms_percent == pytest.approx(1.0)
    assert ROW.error_percent == pytest.approx(4.0)
    assert ROW.delay_samples == pytest.approx(STATE.response.delay_s * RATE_HZ)


def test_programs_get_figures_without_coefficients():
    cycle = LearnedCycle.from_coefficients(
        "sine", 100.0, np.zeros(64), np.ones(50, dtype=complex), start_percent=4.0,
        error_percent=0.5,
    )  # fmt: skip
    correction = Correction(sample_rate_hz=RATE_HZ, model_sha256="0" * 64, cycles=(cycle,))
    bands = {("", "sine"): [ResidualBand(700.0, 900.0, 0.2, "uncertain")]}
    result = IlcResult({"": correction}, (ROW, ROW), (ROW,), "done", residual=bands)
    mapping = result.to_mapping()
    text = json.dumps(mapping, allow_nan=False)
    assert "cosine" not in text
    (waveform,) = mapping["waveforms"]
    (band,) = waveform.pop("residual")
    assert waveform == {"axis": "", "label": "sine", "start_percent": 4.0, "error_percent": 0.5}
    assert (band["low_hz"], band["high_hz"], band["cause"]) == (700.0, 900.0, "uncertain")
    assert band["reason"]
    assert mapping["reason"] == "done"


class TestAxes:
    """Waveforms of several axes, and what they have in common."""

    STAGE = CONFIGS / "stage_xy.yaml"
    HOLD = "axes.y.waveform={kind: hold, unit: um, level: 0.0, duration_s: 3.0}"

    @staticmethod
    def groups(*settings):
        found, alone = learners_of(checked_run(TestAxes.STAGE, settings))
        return [[(each.axis, each.cycles) for each in group] for group in found], alone

    def test_axes_with_equal_periods(self):
        assert self.groups() == ([[("x", 1), ("y", 1)]], {})

    def test_axes_with_a_common_period(self):
        settings = ["axes.x.waveform.frequency_hz=30", "axes.y.waveform.frequency_hz=20"]
        assert self.groups(*settings) == ([[("x", 3), ("y", 2)]], {})

    def test_axes_without_a_common_period_are_refused(self):
        with pytest.raises(ConfigError, match=r"20 Hz, 20\.3 Hz for x and y") as error:
            self.groups("axes.y.waveform.frequency_hz=20.3")
        assert [each.key for each in error.value.problems] == ["waveform"]
        assert self.groups("axes.y.waveform.frequency_hz=20.3", "axis=y") == ([[("", 1)]], {})

    def test_an_axis_that_does_not_repeat_is_left_alone(self):
        found, alone = self.groups(self.HOLD)
        assert found == [[("x", 1)]]
        assert "2 whole cycles" in alone["y"]

    def test_an_experiment_in_which_no_axis_repeats_is_refused(self):
        with pytest.raises(ConfigError) as error:
            self.groups(self.HOLD, self.HOLD.replace("axes.y", "axes.x"))
        assert {each.key for each in error.value.problems} == {"waveform"}

    def test_waveforms_one_after_another_learn_by_themselves(self):
        part = "{kind: sine, unit: um, amplitude: 20.0, frequency_hz: %d, duration_s: 0.5}"
        both = f"{{kind: sequence, unit: um, parts: [{part % 20}, {part % 25}]}}"
        groups, _ = self.groups(f"axes.x.waveform={both}", f"axes.y.waveform={both}")
        assert groups == [[("x", 1), ("y", 1)]] * 2
        assert self.groups(f"axes.x.waveform={both}", "axis=x")[0] == [[("", 1)]] * 2

    def test_learning_continues_from_a_correction_of_one_axis(self, tmp_path):
        """Its period is a third of the common one: each harmonic is the third one there."""
        rate_hz, own = 50_000.0, checked_run(self.STAGE, ["axis=x", "waveform.frequency_hz=30"])
        ((learner,),), _ = learners_of(own)
        coefficients = np.array([0.5, 0.2 + 0.1j, 0.05j])
        cycle = LearnedCycle.from_coefficients(
            learner.segment.label, learner.period,
            signature(own.first.reference.values, learner.segment), coefficients,
        )  # fmt: skip
        digest = model_sha256(own.first.loaded.model)
        file = tmp_path / "x.yaml"
        made = Correction(sample_rate_hz=rate_hz, model_sha256=digest, cycles=(cycle,))
        write_correction(file, made, overwrite=False)
        settings = ["axes.x.waveform.frequency_hz=30", correction_setting(file, "x")]
        ((first, second),), _ = learners_of(checked_run(self.STAGE, settings))
        assert (first.cycles, second.cycles) == (3, 2)
        next_um = beginning(first).next_um
        np.testing.assert_array_equal(next_um[:9:3], coefficients)
        assert np.count_nonzero(next_um) == 3
        assert not beginning(second).next_um.any()

    @pytest.mark.slow
    def test_all_axes_learn_from_the_same_runs(self, tmp_path):
        runs = Runs()
        session = IlcSession(
            self.STAGE,
            [
                "waveform.duration_s=0.7",
                self.HOLD.replace("axes.y", "axes.z"),
                "axes.z.device.seed=3",
            ],
            tmp_path,
        )
        host = StudyHost(run=runs, real_time=False)
        found = run_study(session.study(2, lambda rows: None), tmp_path, host, resume=False)
        assert [(row.run, row.axis) for row in found.rows] == [
            (number, axis) for number in range(3) for axis in "xy"
        ]
        assert [row.axis for row in found.check] == ["x", "y"]
        assert list(found.corrections) == ["x", "y"]
        assert list(found.alone) == ["z"]
        assert runs.settings[1][-5:] == [
            *(correction_setting(tmp_path / f"run-01.{axis}.yaml", axis) for axis in "xy"),
            *(
                f"axes.{axis}.device.seed={seed + 1}"
                for axis, seed in zip("xyz", (1, 2, 3), strict=True)
            ),
        ]
        first, *_, last = found.rows
        assert last.contour_percent < 0.2 * first.contour_percent
        assert Path(last.recording).name == "run-02.y.mcap"
