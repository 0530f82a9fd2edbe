"""Characterisation runner: skipped and kept steps, problems, pauses."""

from dataclasses import replace

import numpy as np
import pytest

from hilctl.base.errors import InputError, RunError
from hilctl.base.yaml import setting
from hilctl.experiment.load import load_experiment
from hilctl.lab.studies import study
from hilctl.lab.studies.characterise import characterisation_runner
from hilctl.lab.studies.characterise.characterisation_runner import (
    CharacterisationRunner,
    without_reference,
)
from hilctl.lab.studies.characterise.steps import STEPS
from hilctl.lab.studies.characterise.waveforms import biased_loops
from hilctl.lab.studies.study import REPEATS, StudyHost
from hilctl.recording.reader import read
from hilctl.run.start import unpaced
from tests.unit.lab.studies.conftest import StudyRig

FEW = ("rest", "polarity", "growing-1", "growing-2")
SHORT = tuple(step for step in STEPS if step.name.startswith(FEW))


class Rig(StudyRig):
    def host(self):
        return StudyHost(**self.observers, on_step=self.rows.append)


@pytest.fixture(autouse=True)
def short(monkeypatch):
    """Use few steps and no model."""
    monkeypatch.setattr(characterisation_runner, "STEPS", SHORT)
    monkeypatch.setattr(characterisation_runner, "identified", lambda *_, **__: None)
    monkeypatch.setattr(
        CharacterisationRunner, "_with_model", lambda self, *_, **__: self._so_far()
    )


BUDGET = ["limits.rms_current_a=0.05", "limits.thermal_time_constant_s=20.0"]


def runner_of(experiment, host, *settings, folder="runs"):
    return CharacterisationRunner(
        experiment, list(settings), experiment.parent / folder, None, host
    )


def run(experiment, rig, *settings, folder="runs"):
    runner = runner_of(experiment, rig.host(), *settings, folder=folder)
    return runner.characterise(experiment.parent / "model.yaml")


@pytest.mark.slow
def test_each_step_is_a_run_with_noise_of_its_own(experiment):
    rig = Rig()
    found = run(experiment, rig)
    assert rig.names == [
        "01-rest.mcap", "02-polarity-1.mcap", "05-growing-1.mcap",
        "06-growing-2.mcap",
    ]  # fmt: skip
    assert [each.settings[-1] for each in rig.runs] == [
        "device.seed=4", "device.seed=5", "device.seed=8", "device.seed=9",
    ]  # fmt: skip
    assert [row.name for row in rig.rows] == ["rest", "polarity-1", "growing-1", "growing-2"]
    assert found.steps == tuple(rig.rows)
    assert "noise 0.035" in rig.rows[0].text
    done = [part for part, _ in rig.texts]
    assert done == sorted(done)
    assert rig.texts[0][1].startswith("rest (")
    assert found.measured.reaction.gain_um > 3.0


def test_completed_steps_are_not_run_again(experiment):
    first = run(experiment, Rig())
    rig = Rig()
    again = run(experiment, rig)
    assert rig.runs == []
    assert [row.kept for row in rig.rows] == [True] * 4
    assert again.measured.reaction == first.measured.reaction


@pytest.mark.parametrize("size", [20_000, 7], ids=["truncated", "no recording"])
def test_a_step_without_its_recording_is_run_again(experiment, size):
    run(experiment, Rig())
    path = experiment.parent / "runs" / "02-polarity-1.mcap"
    path.write_bytes(path.read_bytes()[:size])
    rig = Rig()
    run(experiment, rig)
    assert rig.names == ["02-polarity-1.mcap"]


def test_a_step_that_skips_ticks_is_run_again(experiment, monkeypatch):
    def skipping(path):
        whole = read(path)
        kept = np.arange(whole.samples.index.size) % 50 > 0
        return replace(whole, samples=whole.samples.rows(kept))

    with monkeypatch.context() as patched:
        patched.setattr(study, "read", skipping)
        for _ in range(2):
            rig = Rig()
            with pytest.raises(RunError, match=r"rest .* 2 % "):
                run(experiment, rig)
            assert rig.names == ["01-rest.mcap"] * (1 + REPEATS)
    rig = Rig()
    run(experiment, rig)
    assert "01-rest.mcap" not in rig.names


@pytest.mark.parametrize("missing", ["skipped", "invalid"])
def test_a_multisine_with_gaps_is_run_again_though_the_run_has_few(
    experiment, monkeypatch, missing
):
    def with_gaps(path):
        whole = read(path)
        samples = whole.samples
        if "response" not in path.name:
            return whole
        (multisine,) = (each for each in whole.segments if each.kind == "multisine")
        steady = (multisine.steady_start <= samples.index) & (samples.index < multisine.steady_stop)
        bad = np.flatnonzero(steady)[::90]
        assert bad.size < 0.01 * samples.index.size
        if missing == "skipped":
            return replace(whole, samples=samples.rows(np.delete(np.arange(steady.size), bad)))
        samples.displacement_um[bad] = np.nan
        return whole

    steps = ("rest", "polarity", "response")
    monkeypatch.setattr(
        characterisation_runner, "STEPS", tuple(s for s in STEPS if s.name.startswith(steps))
    )
    rig = Rig()
    with monkeypatch.context() as patched:
        patched.setattr(study, "read", with_gaps)
        with pytest.raises(RunError, match=r"response-1 .* 1.1 % "):
            run(experiment, rig)
    assert rig.names[-2:] == ["05-response-1.mcap"] * 2
    assert rig.names.count("05-response-1.mcap") == 1 + REPEATS


def test_recordings_with_other_settings_are_not_replaced(experiment):
    run(experiment, Rig())
    rig = Rig()
    with pytest.raises(InputError, match="overwrite"):
        run(experiment, rig, "limits.peak_current_a=3.0")
    assert rig.names == []


def test_discarding_starts_again(experiment):
    run(experiment, Rig())
    runner_of(experiment, Rig().host()).discard()
    assert not list((experiment.parent / "runs").glob("*.mcap"))


def test_a_problem_of_the_rig_is_a_result(experiment):
    fault = "device.fault={kind: sensor_inverted, at_sample: 0}"
    found = run(experiment, Rig(), fault)
    assert found.problem_code == "wrong_polarity"
    assert "wires" in found.problem
    assert found.measured.rest is not None
    assert [row.name for row in found.steps] == ["rest", "polarity-1"]


def test_a_sensor_at_its_end_is_named(experiment):
    fault = "device.fault={kind: sensor_nan, at_sample: 3000}"
    with pytest.raises(RunError, match="rest "):
        run(experiment, Rig(), fault)


@pytest.mark.slow
def test_the_coil_is_let_cool(experiment):
    """The second growing loop waits for the heat of the first."""
    rig = Rig()
    run(experiment, rig, *BUDGET)
    assert rig.pauses
    assert sum(rig.pauses) < 100.0
    assert any("cools" in text for _, text in rig.texts)


@pytest.mark.slow
def test_where_the_output_is_given_by_hand_it_is_at_rest_after_the_first_step(experiment):
    rig = Rig()
    run(experiment, rig, "safe={value: 0.0, at_start: 0.5}", "device.output_at_open=null")
    given = [[s for s in each.settings if "at_start=" in s] for each in rig.runs]
    assert given == [[], *([["safe.at_start=0.0"]] * 3)]


def test_the_plan_says_steps_time_and_disk(experiment):
    rig = Rig()
    plan = runner_of(experiment, rig.host()).plan
    assert [step.name for step in plan.steps] == [step.name for step in SHORT]
    assert plan.seconds == pytest.approx(sum(step.seconds for step in plan.steps))
    assert plan.megabytes == pytest.approx(plan.seconds * 5000 * 45e-6)
    assert rig.runs == []
    assert not (experiment.parent / "runs").exists()


def test_a_full_disk_is_said_before_anything_moves(experiment):
    rig = Rig()
    runner = runner_of(experiment, rig.host())
    runner.__dict__["plan"] = replace(runner.plan, free_mb=0.1)
    with pytest.raises(InputError, match="no room"):
        runner.characterise(experiment.parent / "model.yaml")
    assert rig.runs == []


def test_a_real_device_keeps_real_time(experiment, monkeypatch):
    from hilctl_drivers.simulated.devices import SimulatedTerfenol

    info = SimulatedTerfenol.info
    monkeypatch.setattr(
        SimulatedTerfenol, "info", property(lambda self: replace(info.fget(self), simulated=False))
    )
    with pytest.raises(InputError, match="--fast: simulated_terfenol"):
        runner_of(experiment, StudyHost(run=unpaced, real_time=False))


COMPENSATED = """\
name: rig
device: {kind: simulated_terfenol}
sample_rate_hz: 5000
waveform: {kind: sine, unit: um, amplitude: 4.0, frequency_hz: 2.0, duration_s: 1.0}
compensator: {model: nowhere.yaml}
feedback: {limit_um: 1.0, bandwidth_hz: 10.0}
adaptation: {noise_um: 0.1}
trigger: {output: on_target, start: high}
on_target: {tolerance_um: 0.5}
limits:
  {peak_current_a: 4.0, slew_a_per_s: 5000.0, stroke_um: [-50.0, 50.0], tracking_error_um: 5.0,
   tracking_s: 0.1, frozen_s: 1.0}
"""


def test_settings_that_need_a_reference_are_removed(tmp_path, limits):
    path = tmp_path / "compensated.yaml"
    path.write_text(COMPENSATED, encoding="utf-8")
    settings = without_reference(path, [])
    keys = biased_loops(limits, 2.0)
    loaded = load_experiment(path, [*settings, setting("waveform", keys)])
    config, limits = loaded.config, loaded.config.limits
    assert loaded.model is config.feedback is config.adaptation is config.trigger is None
    assert config.on_target is None
    assert limits.tracking_error_um is limits.tracking_s is None
    assert limits.frozen_s == 1.0
    assert len(loaded.config.waveform.parts) == len(keys["parts"])


def test_an_experiment_without_all_that_is_held_in_its_unit(experiment):
    volts = "limits={drive_v: [0, 1], slew_v_per_s: 1.0, stroke_um: [0, 1]}"
    for given, unit in (([], "A"), ([volts], "V")):
        *kept, waveform, compensator = without_reference(experiment, given)
        assert (kept, compensator) == (given, "compensator=none")
        assert f'"unit": "{unit}"' in waveform
