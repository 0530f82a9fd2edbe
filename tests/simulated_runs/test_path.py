"""The path of a new user: init, check, characterise, run and learn, with nothing edited."""

from pathlib import Path

import pytest

from hilctl import api
from hilctl.analysis.report import summarize
from hilctl.recording.reader import read

QUICK = ("sample_rate_hz=1000", "block=10")

RIGS = {
    "current, both signs": ("simulated_terfenol", (), 1.2),
    "current, one sign": ("simulated_terfenol", ("limits.drive_a=[0.0, 6.0]",), 1.2),
    "voltage, one sign": ("simulated_piezo", (), 0.24),
}
"""Device, settings of ``init``, and 1.5 times the validation error with limits set by hand."""
PHYSICS = {"domains": 1.2, "diffusion": 1.2, "jiles_atherton": 1.2}


@pytest.mark.parametrize(
    ("device", "settings", "within_percent"),
    [
        *(pytest.param(*rig, id=name) for name, rig in RIGS.items()),
        *(
            pytest.param(
                "simulated_terfenol",
                (f"device.physics={name}",),
                percent,
                id=name,
                marks=pytest.mark.long,
            )
            for name, percent in PHYSICS.items()
        ),
    ],
)
def test_a_rig_is_compensated_by_default(tmp_path, device, settings, within_percent):
    rig, model = tmp_path / "rig.yaml", tmp_path / "model.yaml"
    api.init(device, rig, settings=[*settings, *QUICK])
    assert api.check(rig).warnings == ()
    found = api.characterise(rig, model, fast=True)
    assert (found.problem, found.verdict.grade) == ("", "good")
    assert found.held_out[0].peak_percent < within_percent
    assert api.check(rig, found.first_run).warnings == ()
    run = api.run(rig, tmp_path / "run.mcap", settings=found.first_run, fast=True)
    assert run.code == "completed"
    before = summarize(read(run.path)).peak_error_percent
    assert before < 2.0
    learned = api.learn(rig, tmp_path / "learned.yaml", settings=found.first_run, fast=True)
    assert Path(tmp_path / "learned.yaml").is_file()
    assert learned.check[0].error_percent < before
