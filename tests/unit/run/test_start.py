"""Names of recordings and logs, and runs of programs that have threads."""

import signal
import time
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest

from hilctl.base.errors import ConfigError, ConfigProblem, InputError, RunError
from hilctl.experiment.load import load_experiment
from hilctl.recording.reader import read
from hilctl.run import start
from hilctl.run.start import (
    RunKey,
    checked_experiment,
    checked_run,
    completed_key,
    default_output,
    output_of,
    run_in_own_process,
    unpaced,
    unused,
)
from tests.unit.lab.studies.campaign.conftest import experiment

__all__ = ["experiment"]

DEMO = Path(__file__).parents[3] / "configs" / "demo.yaml"
NOON = time.struct_time((2026, 1, 2, 12, 0, 5, 4, 2, 0))


def test_used_name_gets_a_number(tmp_path):
    assert default_output("sine", tmp_path, NOON) == tmp_path / "sine-20260102-120005.mcap"
    (tmp_path / "sine-20260102-120005.mcap").symlink_to(tmp_path / "nowhere")
    (tmp_path / "sine-20260102-120005-2.mcap").touch()
    assert default_output("sine", tmp_path, NOON) == tmp_path / "sine-20260102-120005-3.mcap"


def test_recording_folder_is_created(tmp_path):
    folder = tmp_path / "new" / "runs"
    checked = checked_run(DEMO, [f"recording.folder={folder}"])
    assert output_of(checked, tmp_path / "mine.mcap") == tmp_path / "mine.mcap"
    assert not folder.exists()
    assert output_of(checked, None).parent == folder
    assert folder.is_dir()


def test_recording_folder_that_cannot_be_created_is_reported(tmp_path):
    (tmp_path / "file").touch()
    checked = checked_run(DEMO, [f"recording.folder={tmp_path / 'file' / 'runs'}"])
    with pytest.raises(InputError, match="Not a directory"):
        output_of(checked, None)


@pytest.mark.parametrize("holds", [("tcp:10.0.0.5:502",), ()])
def test_a_killed_run_of_a_device_is_recovered_before_its_state_is_read(monkeypatch, holds):
    done = []

    def load(*given):
        loaded = load_experiment(*given)
        device = SimpleNamespace(info=replace(loaded.device.info, holds=holds))
        return replace(loaded, device=device)

    monkeypatch.setattr(start, "load_experiment", load)
    monkeypatch.setattr(start, "finish_dead_runs", lambda: done.append("recovered"))
    monkeypatch.setattr(start, "check", lambda *given: done.append("checked"))
    checked_experiment(DEMO, [])
    assert done == ["recovered"] * bool(holds) + ["checked"]


BUDGET = ["limits.rms_current_a=2.0", "limits.thermal_time_constant_s=1.0"]


def test_recording_is_identified_by_experiment_and_model(experiment, tmp_path):
    result = unpaced(experiment, [], tmp_path / "a.mcap")
    assert completed_key(result.path) == RunKey.of(load_experiment(experiment))
    assert completed_key(result.path) != RunKey.of(load_experiment(experiment, ["block=10"]))


def test_incomplete_recording_has_no_key(experiment, tmp_path):
    fault = ["device.fault={kind: sensor_nan, at_sample: 100}"]
    assert completed_key(unpaced(experiment, fault, tmp_path / "a.mcap").path) is None
    (tmp_path / "text.mcap").write_text("no recording")
    assert completed_key(tmp_path / "text.mcap") is None
    assert completed_key(tmp_path / "absent.mcap") is None


def test_recording_has_the_heat_of_the_coil_before_and_after(experiment, tmp_path):
    first = read(unpaced(experiment, BUDGET, tmp_path / "a.mcap").path)
    left = float(first.end["coil_heat_a2"])
    assert float(first.run["coil_heat_a2"]) == 0.0
    assert 0.3 < left < 1.0
    again = read(unpaced(experiment, BUDGET, tmp_path / "b.mcap", heat_a2=left).path)
    assert float(again.run["coil_heat_a2"]) == left
    assert float(again.end["coil_heat_a2"]) > left


def test_log_does_not_replace_another_file(tmp_path):
    log = tmp_path / "run.log"
    assert unused(log, ".") == log
    log.write_text("mine")
    (tmp_path / "run.2.log").symlink_to(tmp_path / "nowhere")
    assert unused(log, ".") == tmp_path / "run.3.log"


GIVEN = ("x.yaml", (), None, False, 0.0, False)


@pytest.fixture
def answering(monkeypatch):
    """Return a function that sets the Python program of a run's process."""

    def says(code):
        first = "import os, pickle, signal, sys; answers = os.fdopen(int(sys.argv[1]), 'wb')"
        monkeypatch.setattr(start, "_START", f"{first}\n{code}")

    return says


def test_errors_are_passed_between_processes(answering):
    answering(
        "from hilctl.base.errors import ConfigError, ConfigProblem\n"
        "error = ConfigError([ConfigProblem('x.yaml:1', 'name', 'is required')])\n"
        "pickle.dump(error, answers)"
    )
    with pytest.raises(ConfigError) as refused:
        run_in_own_process(GIVEN, print)
    assert refused.value.problems == (ConfigProblem("x.yaml:1", "name", "is required"),)


@pytest.mark.parametrize("code", ["", "answers.write(b'cut')", "os._exit(7)"])
def test_process_that_ends_without_a_result_is_a_run_error(answering, code):
    answering(code)
    with pytest.raises(RunError, match=r"code [07]"):
        run_in_own_process(GIVEN, print)


def test_interrupt_is_passed_on_and_handlers_are_as_before(answering):
    answering("import time\nsignal.signal(2, 0)\nos.kill(os.getppid(), 2)\ntime.sleep(60)")
    before = signal.getsignal(signal.SIGINT)
    with pytest.raises(KeyboardInterrupt):
        run_in_own_process(GIVEN, print)
    assert signal.getsignal(signal.SIGINT) is before


def test_display_that_fails_ends_no_run(answering):
    answering(
        "from hilctl.run.result import Progress\nfrom hilctl.base.errors import InputError\n"
        "for k in range(9): pickle.dump(Progress(k, 9, 0, True, bytes(100_000)), answers)\n"
        "pickle.dump(InputError('done'), answers)"
    )
    shown = []

    def show(progress):
        shown.append(progress.samples)
        raise ValueError

    with pytest.raises(InputError, match="done"):
        run_in_own_process(GIVEN, show)
    assert shown == [0]
