"""The path of a new user: init, check, characterise, run and learn, with nothing edited."""

import pytest

from hilctl import api
from hilctl.analysis.report import summarize
from hilctl.recording.reader import read
from hilctl_drivers.simulated.devices import PiezoStage
from tests.simulated_runs.test_wires import BOARD, Wire, emulated

STAGE = f"device.stage={PiezoStage.fitted((-100.0, 100.0), 38.0, 100.0).model_dump_json()}"
QUICK = ("sample_rate_hz=1000", "block=10")

RIGS = {
    "voltage, one sign": ("simulated_piezo", (), 0.24),
}
"""Device, settings of ``init``, and 1.5 times the validation error with limits set by hand."""
MORE_RIGS = {
    "current, both signs": ("simulated_terfenol", (), 1.2),
    "current, one sign": ("simulated_terfenol", ("limits.drive_a=[0.0, 6.0]",), 1.2),
    "voltage, both signs": ("simulated_piezo", (STAGE,), 0.24),
    "domains": ("simulated_domains", (), 1.2),
    "diffusion": ("simulated_diffusion", (), 1.2),
    "jiles_atherton": ("simulated_jiles_atherton", (), 1.2),
}


LEARNED_PERCENT = 0.05
NOISE_SPREAD = 1.1


def follow(folder, device, settings, within_percent, *, fast=True):
    rig, model, learned = (folder / f"{name}.yaml" for name in ("rig", "model", "learned"))
    api.init(device, rig, settings=settings)
    assert api.check(rig).warnings == ()
    found = api.characterise(rig, model, fast=fast)
    assert (found.problem, found.is_model) == ("", True)
    assert found.held_out[0].peak_percent < within_percent
    assert api.check(rig, found.first_run).warnings == ()
    run = api.run(rig, folder / "run.mcap", settings=found.first_run, fast=fast)
    assert run.code == "completed"
    before = summarize(read(run.path)).peak_error_percent
    assert before < 2.0
    result = api.learn(rig, learned, settings=found.first_run, fast=fast)
    assert learned.is_file()
    if len(result.rows) == 1:  # nothing is left to learn: another run differs by its noise alone
        assert result.reason == "at the noise floor"
        return
    # A model without a residual error leaves only noise, whose peak differs from run to run.
    noise_percent = max(LEARNED_PERCENT, NOISE_SPREAD * result.check[0].floor_percent)
    assert result.check[0].error_percent < max(before, noise_percent)


@pytest.mark.parametrize(("device", "settings", "percent"), RIGS.values(), ids=RIGS)
def test_a_simulated_rig_is_compensated_by_default(tmp_path, device, settings, percent):
    follow(tmp_path, device, (*settings, *QUICK), percent)


@pytest.mark.long
@pytest.mark.parametrize(("device", "settings", "percent"), MORE_RIGS.values(), ids=MORE_RIGS)
def test_other_rigs_are_compensated_by_default(tmp_path, other_rigs, device, settings, percent):
    follow(tmp_path, device, (*settings, *QUICK), percent)


PATIENT = (
    "device.fifo_blocks=60",
    "device.timeout_s=2.0",
    "device.watchdog.timeout_s=20.0",
    "timing.max_late_s=30.0",
)
"""Settings that survive the stalls of a busy machine."""


@pytest.mark.long
@pytest.mark.timeout(900)
def test_emulated_board_is_compensated_by_default(tmp_path):
    with emulated(Wire("cobs_board_fifo", BOARD, 10_000.0), tmp_path) as device:
        at = f"device.serial_port={device['serial_port']}"
        follow(tmp_path, "cobs_board_fifo", (at, *PATIENT), 1.2, fast=False)
