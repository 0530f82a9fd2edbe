"""Plans: every step is checked in advance."""

import pytest

from hilctl.base.errors import ConfigError, InputError
from hilctl.lab.studies.campaign.plan import planned
from tests.unit.base.test_calibration import CALIBRATION
from tests.unit.lab.studies.campaign.conftest import CAMPAIGN

HOT = "set: {limits.rms_current_a: 0.7, limits.thermal_time_constant_s: 2.0}\n"


def test_what_it_takes(campaign, tmp_path):
    plan = planned(campaign(), tmp_path / "runs", {}, 0.0)
    assert plan.seconds == pytest.approx(4 * 0.4)
    assert (plan.pauses_s, len(plan.left)) == (0.0, 4)
    assert 0.0 < plan.megabytes < 1.0
    assert not (tmp_path / "runs").exists()


def test_a_step_that_breaks_a_limit_is_refused_before_the_first_run(campaign, tmp_path):
    text = CAMPAIGN.replace("[1.0, 2.0]", "[1.0, -2.0, 5.0]")
    with pytest.raises(ConfigError) as found:
        planned(campaign(text), tmp_path / "runs", {}, 0.0)
    said = str(found.value).splitlines()
    assert len(said) == 2
    assert "few.yaml:4: waveform.amplitude:" in said[0]
    assert "step 3 (waveform.amplitude=-2.0, waveform.frequency_hz=10.0)" in said[0]
    assert "rig.yaml:7: limits.peak_current_a:" in said[1]
    assert "step 5" in said[1]


def test_what_is_wrong_with_all_of_them_is_said_once(campaign, tmp_path):
    for setting in ("limits.slew_a_per_s=1.0", "blok=1"):
        with pytest.raises(ConfigError) as found:
            planned(campaign(CAMPAIGN, setting), tmp_path, {}, 0.0)
        assert len(found.value.problems) == 1
        assert str(found.value).endswith("in every step)")


def test_no_experiment(campaign, experiment, tmp_path):
    few = campaign()
    experiment.unlink()
    with pytest.raises(InputError, match=r"few.yaml:2: experiment: .*rig.yaml"):
        planned(few, tmp_path, {}, 0.0)


def test_the_coil_cools_between_steps(campaign, tmp_path):
    few = campaign(CAMPAIGN + HOT)
    cold, hot = (planned(few, tmp_path, {}, heat_a2) for heat_a2 in (0.0, 0.48))
    assert cold.steps[0].pause_s == 0.0
    assert cold.pauses_s > 0.0
    assert hot.pauses_s > cold.pauses_s
    to = planned(campaign(CAMPAIGN + HOT + "cool_down: {to_rms_a: 0.1}\n"), tmp_path, {}, 0.0)
    assert [each.heat_a2**0.5 <= 0.1 + 1e-9 for each in to.steps] == [True] * 4
    assert to.pauses_s > cold.pauses_s


def test_completed_steps_are_not_planned(campaign, tmp_path):
    """Each recording counts once, for the same experiment only."""
    twice = campaign(CAMPAIGN + "repeat: 2")
    plan = planned(twice, tmp_path, {}, 0.0)
    completed = {plan.steps[0].keys: [(tmp_path / "a.mcap",)]}
    again = planned(twice, tmp_path, completed, 0.0)
    assert [each.kept is not None for each in again.steps] == [True] + [False] * 7
    longer = campaign(CAMPAIGN + "set: {waveform.duration_s: 0.5}")
    assert len(planned(longer, tmp_path, completed, 0.0).left) == 4


def test_a_calibration_is_no_obstacle(campaign, tmp_path):
    (tmp_path / "calibration.yaml").write_text(CALIBRATION, encoding="utf-8")
    keys = "device.calibration: calibration.yaml, limits.stroke_um: [-45.0, 45.0]"
    text = CAMPAIGN + f"set: {{{keys}}}\n"
    assert len(planned(campaign(text), tmp_path / "runs", {}, 0.0).left) == 4
    assert len(planned(campaign(text), tmp_path / "runs", {}).left) == 4


def test_heat_of_the_last_run_is_no_error(campaign, tmp_path, monkeypatch):
    """It causes a pause."""
    monkeypatch.setattr("hilctl.experiment.preflight.heat_before", lambda loaded, now: (0.48, ()))
    plan = planned(campaign(CAMPAIGN + HOT), tmp_path, {}, 0.48)
    assert plan.steps[0].pause_s > 0.0
