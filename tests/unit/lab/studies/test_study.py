"""Engine of studies: resume, cooling, repeats, progress, names, errors and stops."""

import signal
from dataclasses import replace

import numpy as np
import pytest

from hilctl.base.errors import ConfigError, DataError, InputError, RunError
from hilctl.base.events import Event
from hilctl.lab.studies import study
from hilctl.lab.studies.study import (
    REPEATS,
    StepFaultError,
    StepStoppedError,
    StudyHost,
    StudyStep,
    free_mb,
    require_room,
    run_study,
)
from hilctl.run.start import unpaced
from tests.unit.lab.studies.campaign.conftest import experiment
from tests.unit.lab.studies.conftest import StudyRig

__all__ = ["experiment"]

BUDGET = {"limits.rms_current_a": 0.7, "limits.thermal_time_constant_s": 3.0}


class Rig(StudyRig):
    rate_hz = 2000.0

    @property
    def host(self):
        return StudyHost(**self.observers)


@pytest.fixture
def steps(experiment):
    """Return a study that yields steps, and returns their runs."""

    def make(*given, **common):
        runs = []
        for settings in given:
            run = yield StudyStep(experiment, settings, **common)
            runs.append(run)
        return runs

    return make


AMPLITUDES = [{"waveform.amplitude": each} for each in (1.0, 1.5, 2.0)]


def test_a_study_decides_from_the_runs_so_far(experiment, tmp_path):
    def largest(experiment):
        amplitude = 1.0
        while True:
            run = yield StudyStep(experiment, {"waveform.amplitude": amplitude})
            if abs(run.recording.samples.displacement_um).max() > 5.0:
                return amplitude
            amplitude *= 2.0

    rig = Rig()
    assert run_study(largest(experiment), tmp_path / "new", rig.host) == 2.0
    assert rig.names == ["rig-0001.mcap", "rig-0002.mcap"]


def test_completed_steps_are_not_run_again(steps, tmp_path):
    first = run_study(steps(*AMPLITUDES), tmp_path, Rig().host)
    first[1].path.unlink()
    rig = Rig()
    again = run_study(steps(*AMPLITUDES[::-1]), tmp_path, rig.host)
    assert [run.kept for run in again] == [True, False, True]
    assert [run.path.name for run in again] == [
        "rig-0003.mcap", "rig-0002.mcap", "rig-0001.mcap",
    ]  # fmt: skip
    assert rig.names == ["rig-0002.mcap"]
    without = run_study(steps(*AMPLITUDES), tmp_path, Rig().host, resume=False)
    assert not any(run.kept for run in without)


def test_a_recording_counts_once(steps, tmp_path):
    run_study(steps({}), tmp_path, Rig().host)
    runs = run_study(steps({}, {}), tmp_path, Rig().host)
    assert [run.kept for run in runs] == [True, False]


def test_no_recording_is_replaced_unless_a_step_replaces_it(steps, tmp_path):
    run_study(steps({}, name="a"), tmp_path, Rig().host)
    runs = run_study(steps(*AMPLITUDES[:1], name="a"), tmp_path, Rig().host)
    assert [run.path.name for run in runs] == ["a-2.mcap"]
    rig = Rig()
    with pytest.raises(InputError, match="other settings"):
        run_study(steps(*AMPLITUDES[1:], name="a", replaces=True), tmp_path, rig.host)
    assert rig.runs == []
    changed = steps(*AMPLITUDES[1:], name="a", replaces=True)
    runs = run_study(changed, tmp_path, Rig().host, resume=False)
    assert [run.path.name for run in runs] == ["a.mcap"] * 2


def test_a_repeat_follows_a_stall(steps, tmp_path):
    stalls = ["timing not kept"]
    rig = Rig()
    runs = run_study(
        steps({}, flaw=lambda recording: stalls.pop() if stalls else ""), tmp_path, rig.host
    )
    assert rig.names == ["rig-0001.mcap", "rig-0001-2.mcap"]
    assert [run.path.name for run in runs] == rig.names[1:]
    for repeats in (0, REPEATS):
        rig = Rig()
        with pytest.raises(StepFaultError, match="late"):
            run_study(
                steps({}, name="a", flaw=lambda recording: "late", repeats=repeats),
                tmp_path / str(repeats), rig.host,
            )  # fmt: skip
        assert len(rig.runs) == 1 + repeats


@pytest.mark.parametrize(("codes", "output", "at_start", "stalled", "harmless"), [
    (["late"], "confirmed", 0.0, True, True),
    (["late"], "unconfirmed", 0.0, False, False),
    (["device_lost"], "unconfirmed", None, True, False),
    (["sensor_invalid", "run_ended"], "confirmed", 0.0, True, False),
    (["dropped", "run_ended"], "confirmed", 0.0, False, True),
    (["late", "stroke"], "confirmed", 0.0, True, False),
    (["stroke"], "confirmed", None, False, False),
    ([], "confirmed", None, False, False),
])  # fmt: skip
def test_faults(
    steps, tmp_path, monkeypatch, make_recording, codes, output, at_start, stalled, harmless
):
    events = tuple(Event(1, "error", code, "") for code in codes)
    made = make_recording(np.zeros(10), events=events)
    monkeypatch.setattr(study, "read", lambda path: made)
    safe = {} if at_start is None else {"safe.at_start": at_start, "device.output_at_open": None}
    rig = Rig(1, code="fault", reason="by a test", output_state=output)
    with pytest.raises(StepFaultError, match="step 1: by a test") as caught:
        run_study(steps(safe, repeats=0), tmp_path, rig.host)
    assert (caught.value.stalled, caught.value.harmless) == (stalled, harmless)


def test_a_fault_without_a_readable_recording(steps, tmp_path, monkeypatch):
    def damaged(path):
        raise DataError("damaged")

    monkeypatch.setattr(study, "read", damaged)
    with pytest.raises(StepFaultError) as caught:
        run_study(steps({}), tmp_path, Rig(1, code="fault").host)
    assert (caught.value.stalled, caught.value.harmless) == (False, False)


def test_a_study_may_go_on_after_an_error(experiment, tmp_path):
    def tried(experiment):
        refused = 0
        for amplitude in (1.0, 99.0, 2.0):
            try:
                yield StudyStep(experiment, {"waveform.amplitude": amplitude})
            except ConfigError:
                refused += 1
        return refused

    rig = Rig()
    assert run_study(tried(experiment), tmp_path, rig.host) == 1
    assert len(rig.runs) == 3


@pytest.mark.parametrize(("number", "expected"), [(1, InputError), (2, RunError)])
def test_a_refusal_is_an_input_error_before_anything_moved(steps, tmp_path, number, expected):
    rig = Rig(number, InputError("too fast"))
    with pytest.raises(expected, match="too fast"):
        run_study(steps(*AMPLITUDES), tmp_path, rig.host)
    assert len(rig.runs) == number


@pytest.mark.parametrize(("ends", "number"), [
    ({"code": "stopped", "stop_signal": signal.SIGTERM}, signal.SIGTERM),
    ({"error": KeyboardInterrupt()}, signal.SIGINT),
])  # fmt: skip
def test_a_stopped_study_runs_no_further_step(experiment, tmp_path, ends, number):
    def stubborn(experiment):
        while True:
            try:
                yield StudyStep(experiment)
            except RunError:
                continue

    rig = Rig(1, **ends)
    with pytest.raises(StepStoppedError) as caught:
        run_study(stubborn(experiment), tmp_path, rig.host)
    assert (caught.value.signal, caught.value.exit_code) == (number, 128 + number)
    assert (caught.value.result is None) == ("error" in ends)
    assert len(rig.runs) == 1


def test_an_interrupted_evaluation_stops_the_study(experiment, tmp_path):
    def evaluated(experiment):
        yield StudyStep(experiment)
        raise KeyboardInterrupt

    with pytest.raises(StepStoppedError) as caught:
        run_study(evaluated(experiment), tmp_path, Rig().host)
    assert caught.value.exit_code == 130


def test_an_experiment_that_changes_meanwhile_ends_the_study(steps, experiment, tmp_path):
    class Changing(Rig):
        def __call__(self, path, *given, **more):
            experiment.write_text(experiment.read_text() + "description: another\n")
            return super().__call__(path, *given, **more)

    with pytest.raises(RunError, match="changed"):
        run_study(steps({}), tmp_path, Changing().host)


def test_heat_of_the_coil_carries_over(steps, tmp_path):
    """Each run starts with the heat of the previous one after cooling, also after a resume."""
    hot = [{"waveform.amplitude": 2.5, "waveform.offset": each, **BUDGET} for each in (0.0, 0.01)]
    rig = Rig()
    first, second = run_study(steps(*hot, text="hot"), tmp_path, rig.host)
    left = float(first.recording.end["coil_heat_a2"])
    assert rig.runs[0].heat_a2 == 0.0 < rig.runs[1].heat_a2 < left
    assert 0.0 < max(rig.pauses) <= 1.0
    cools = [text for _, text in rig.texts if "cools" in text]
    assert all(text.startswith("hot: the coil cools") for text in cools)
    second.path.unlink()
    again = Rig()
    run_study(steps(*hot), tmp_path, again.host)
    assert 0.0 < again.runs[0].heat_a2 < left
    later = Rig()
    later.time_s += 3600.0
    run_study(steps(*hot, cool_to_rms_a=0.05), tmp_path, later.host, resume=False)
    assert later.runs[0].heat_a2 == pytest.approx(0.0, abs=1e-9)
    assert later.runs[1].heat_a2 <= 0.05**2 * 1.001


def test_without_real_time_no_coil_cools(steps, tmp_path):
    rig = Rig()
    hot = [{"waveform.amplitude": 2.5, **BUDGET}] * 2
    run_study(steps(*hot), tmp_path, replace(rig.host, real_time=False))
    assert rig.pauses == []
    assert [run.heat_a2 for run in rig.runs] == [0.0, 0.0]


def test_progress_is_of_the_planned_time(steps, tmp_path):
    rig = Rig()
    run_study(steps({}, done_s=5.0), tmp_path / "planned", rig.host, total_s=10.0)
    assert {done for done, _ in rig.texts} == {0.5}
    assert rig.texts[0][1].endswith("step 1; 0:00:05 left")
    rig = Rig()
    run_study(steps({}), tmp_path / "unplanned", rig.host)
    assert rig.texts == [(0.0, "step 1"), (0.5, "step 1")]


def test_disk_space_needs_a_margin(tmp_path):
    assert free_mb(tmp_path / "not" / "made") == pytest.approx(free_mb(tmp_path), rel=0.1)
    require_room(tmp_path, 10.0, 12.0)
    with pytest.raises(InputError, match="no room"):
        require_room(tmp_path, 10.0, 11.9)


class TestAxes:
    """A step with two axes has a recording per axis."""

    AXES = ("axes={x: {device: {seed: 1}}, y: {device: {seed: 2}}}",)

    @pytest.fixture
    def host(self):
        return StudyHost(run=unpaced, real_time=False)

    def test_a_run_has_the_recording_of_each_axis(self, steps, tmp_path, host):
        (run,) = run_study(steps(self.AXES), tmp_path, host)
        assert [path.name for path in run.paths] == ["rig-0001.x.mcap", "rig-0001.y.mcap"]
        assert [each.run["axis"] for each in run.recordings] == ["x", "y"]
        assert run.path == run.recording.path == run.paths[0]

    def test_a_completed_step_has_all_recordings(self, steps, tmp_path, host):
        run_study(steps(self.AXES), tmp_path, host)
        (kept,) = run_study(steps(self.AXES), tmp_path, host)
        assert (kept.kept, len(kept.recordings)) == (True, 2)
        kept.paths[1].unlink()
        (again,) = run_study(steps(self.AXES), tmp_path, host)
        assert (again.kept, again.path.name) == (False, "rig-0001-2.x.mcap")

    def test_a_step_with_other_settings_of_one_axis_is_run(self, steps, tmp_path, host):
        run_study(steps(self.AXES), tmp_path, host)
        other = [*self.AXES, "axes.y.device.seed=3"]
        (run,) = run_study(steps(other), tmp_path, host)
        assert not run.kept

    def test_the_flaw_of_one_axis_repeats_the_run(self, steps, tmp_path, host):
        flaws = iter(["", "wrong"])
        (run,) = run_study(steps(self.AXES, flaw=lambda recording: next(flaws, "")), tmp_path, host)
        assert run.path.name == "rig-0001-2.x.mcap"

    def test_the_hottest_coil_is_waited_for(self, steps, tmp_path):
        budget = [f"{key}={value}" for key, value in BUDGET.items()]
        hot = [*self.AXES, *budget, "axes.x.waveform={amplitude: 0.2}"]

        def paused_s(*settings):
            rig, folder = Rig(), tmp_path / f"{len(settings)}{settings[-1]}"
            host = replace(rig.host, run=unpaced)
            run_study(steps([*hot, *settings], [*hot, *settings]), folder, host)
            return sum(rig.pauses)

        x_s, y_s, both_s = map(paused_s, ("axis=x", "axis=y", "name=rig"))
        assert x_s < 0.5 * y_s
        assert both_s == pytest.approx(y_s, rel=0.1)
