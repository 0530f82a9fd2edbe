"""Campaigns, in real time and without."""

import csv
import importlib.util
import signal
from dataclasses import replace
from types import SimpleNamespace

import pytest

from hilctl.base.errors import DeviceError, InputError
from hilctl.lab.studies.campaign.campaign_runner import (
    planned_fast,
    planned_in_real_time,
    run_fast,
    run_series,
)
from hilctl.lab.studies.campaign.plan import CampaignPlan
from hilctl.lab.studies.study import StepFaultError, StudyHost
from hilctl.recording.reader import read
from hilctl.run.start import completed_key, unpaced
from tests.unit.lab.studies.campaign.conftest import CAMPAIGN, EXPERIMENT
from tests.unit.lab.studies.conftest import StudyRig

BUDGET = "set: {limits.rms_current_a: 0.9, limits.thermal_time_constant_s: 3.0}\n"


class Rig(StudyRig):
    rate_hz = 2000.0

    @property
    def host(self):
        return StudyHost(
            **self.observers,
            on_step=lambda step, row: self.rows.append((step.number, row.code, row.kept)),
        )


@pytest.fixture
def run(campaign, tmp_path):
    def go(rig, text=CAMPAIGN, host=None):
        folder = tmp_path / "runs"
        folder.mkdir(exist_ok=True)
        plan = planned_in_real_time(campaign(text), folder, rig.now())
        return run_series(plan, host or rig.host)

    return go


def codes(result):
    return [row.code for _, row in result.ordered]


def test_every_step_is_run_and_recorded(run, tmp_path):
    rig = Rig()
    result = run(rig)
    assert codes(result) == ["completed"] * 4
    assert rig.names == [f"few-000{k}.mcap" for k in range(1, 5)]
    assert (result.reason, result.stop_signal, result.drift) == ("", 0, None)
    done = [part for part, _ in rig.texts]
    assert done == sorted(done)
    assert 0.0 < done[-1] <= 1.0
    assert rig.texts[1][1].endswith("0:00:01 left")
    assert all(each.is_file() for each in result.tables)
    suffixes = {path.suffix for path in (tmp_path / "runs").iterdir()}
    assert suffixes == {".mcap", ".csv", ".parquet", ".html"}


def test_completed_steps_are_kept_and_nothing_is_overwritten(run, tmp_path):
    run(Rig())
    before = {each: each.read_bytes() for each in (tmp_path / "runs").glob("*.mcap")}
    rig, more = Rig(), CAMPAIGN.replace("[1.0, 2.0]", "[0.5, 1.0, 2.0]")
    result = run(rig, more)
    assert rig.names == ["few-0001-2.mcap", "few-0002-2.mcap"]
    assert rig.rows[:4] == [(number, "completed", True) for number in range(3, 7)]
    assert result.count("completed") == 6
    assert all(path.read_bytes() == content for path, content in before.items())
    again = Rig()
    assert run(again, more).count("completed") == 6
    assert again.runs == []


def test_a_failed_step_is_marked_and_the_campaign_continues(run, monkeypatch):
    """Late ticks are no fault of the rig; the next call repeats the step."""
    monkeypatch.setattr(StepFaultError, "harmless", True)
    result = run(Rig(2, code="fault", reason="late"))
    assert codes(result) == ["completed", "fault", "completed", "completed"]
    assert result.rows[2].result == "fault: late"
    rig = Rig()
    monkeypatch.setattr(
        "hilctl.lab.studies.study_folder.completed_key",
        lambda path: None if path.name == "few-0002.mcap" else completed_key(path),
    )
    assert codes(run(rig)) == ["completed"] * 4
    assert rig.names == ["few-0002-2.mcap"]


@pytest.mark.parametrize(("failure", "codes_of_steps", "reason"), [
    ({"code": "fault", "reason": "stroke"}, ["fault", "planned"], ": stroke"),
    ({"error": DeviceError("no answer")}, ["fault", "planned"], ": no answer"),
    ({"code": "stopped", "stop_signal": 2, "reason": "Ctrl-C"}, ["stopped", "planned"], "C"),
])  # fmt: skip
def test_a_fault_of_device_or_rig_or_the_user_ends_the_campaign(
    run, failure, codes_of_steps, reason
):
    result = run(Rig(3, **failure))
    assert codes(result) == ["completed", "completed", *codes_of_steps]
    assert result.stop_signal == failure.get("stop_signal", 0)
    assert result.reason.startswith("step 3 (waveform.amplitude=2.0, waveform.frequency_hz=10.0)")
    assert result.reason.endswith(reason)


@pytest.mark.slow
def test_heat_of_the_coil_carries_over(run, tmp_path):
    """Each run starts with the heat of the previous one after cooling."""
    rig = Rig()
    text = CAMPAIGN.replace("[1.0, 2.0]", "[2.5]").replace("10.0, 20.0", "10.0, 20.0, 30.0")
    result = run(rig, text + BUDGET + "repeat: 2\n")
    assert set(codes(result)) == {"completed"}, result.reason
    assert sum(rig.pauses) > 1.0
    assert any("cools" in text for _, text in rig.texts)
    paths = sorted((tmp_path / "runs").glob("*.mcap"))
    heats = [float(read(path).end["coil_heat_a2"]) for path in paths]
    begins = [each.heat_a2 for each in rig.runs]
    assert begins[0] == 0.0
    assert all(0.0 < begin <= left for begin, left in zip(begins[1:], heats, strict=False))
    assert max(heats) <= 0.81


def test_cool_down_limits_the_initial_heat(run):
    rig = Rig()
    run(rig, CAMPAIGN + BUDGET + "cool_down: {to_rms_a: 0.05}\n")
    assert all(run.heat_a2 <= 0.05**2 * 1.001 for run in rig.runs)
    assert sum(rig.pauses) > 5.0


@pytest.mark.slow
def test_the_page_is_written_at_intervals(run, drawn_pages):
    """In the first minute the page is written at the end only, later between steps as well."""
    rig = Rig()
    run(rig)
    assert drawn_pages == [("few.html", 4)]

    class Slow(Rig):
        def __call__(self, *given, **keys):
            result = super().__call__(*given, **keys)
            self.time_s += 50.0
            return result

    drawn_pages.clear()
    run(Slow(), CAMPAIGN.replace("name: few", "name: long"))
    assert drawn_pages == [("long.html", 2), ("long.html", 4), ("long.html", 4)]


def test_an_unwritable_page_is_reported(run, monkeypatch):

    def fail(series, path):
        raise InputError(f"{path.name}: no space left")

    monkeypatch.setattr("hilctl.lab.studies.campaign.campaign_runner.write_series", fail)
    rig, notes = Rig(), []
    result = run(rig, CAMPAIGN, replace(rig.host, on_note=notes.append))
    assert codes(result) == ["completed"] * 4
    assert result.page is None
    assert len(notes) == 1
    assert "no space" in notes[0]


def test_ctrl_c_between_two_steps_leaves_a_page(run, drawn_pages):
    result = run(Rig(ends_at=3, error=KeyboardInterrupt()))
    assert result.stop_signal == signal.SIGINT
    assert codes(result) == ["completed", "completed", "planned", "planned"]
    assert drawn_pages == [("few.html", 2)]


FAST_BUDGET = "set: {limits.rms_current_a: 1.3, limits.thermal_time_constant_s: 2.0}\n"


def tables(result):
    return [path.read_bytes() for path in result.tables]


def test_a_campaign_resumes(campaign, tmp_path):
    few = campaign(CAMPAIGN + FAST_BUDGET)
    folder = tmp_path / "runs"
    folder.mkdir()
    rows = []
    host = StudyHost(on_step=lambda step, row: rows.append((step.number, row.kept)))
    first = run_fast(planned_fast(few, folder), host)
    assert first.count("completed") == 4
    whole = tables(first)
    (folder / "few-0003.mcap").unlink()
    rows.clear()
    again = run_fast(planned_fast(few, folder), host)
    assert sorted(rows) == [(1, True), (2, True), (3, False), (4, True)]
    assert tables(again) == whole
    assert first.rows[4].figures.heat_before_a > 0.0


@pytest.mark.skipif(importlib.util.find_spec("distributed") is None, reason="Dask is not installed")
@pytest.mark.filterwarnings("ignore")
def test_a_dask_cluster_gives_the_same_table(campaign, tmp_path):
    from distributed import LocalCluster

    few = campaign(CAMPAIGN + FAST_BUDGET)
    alone, shared = tmp_path / "alone", tmp_path / "shared"
    for folder in (alone, shared):
        folder.mkdir()
    one = run_fast(planned_fast(few, alone), StudyHost())
    with LocalCluster(
        n_workers=1, threads_per_worker=1, processes=False, protocol="tcp", dashboard_address=None
    ) as cluster:
        other = run_fast(planned_fast(few, shared), StudyHost(), cluster.scheduler_address)
    assert tables(other)[0] == tables(one)[0]
    for path in alone.glob("*.mcap"):
        mine, theirs = read(path).samples, read(shared / path.name).samples
        assert mine.displacement_um.tobytes() == theirs.displacement_um.tobytes()


def test_a_row_per_axis(campaign, experiment, tmp_path):
    """A step of two axes is one run; another call keeps it only with all its recordings."""
    axes = "axes:\n  x: {device: {seed: 5}}\n  y: {device: {seed: 6}, waveform: {amplitude: 1.0}}\n"
    experiment.write_text(EXPERIMENT.replace("amplitude: 2.0, ", "") + axes)
    text = CAMPAIGN.replace("  waveform.amplitude: [1.0, 2.0]\n", "").replace(
        "waveform.frequency_hz: [10.0, 20.0]", "axes.x.waveform.amplitude: [1.0, 2.0]"
    )
    folder = tmp_path / "runs"
    few = campaign(text + "reference_run: {every: 2, set: {axes.x.waveform.amplitude: 1.5}}\n")
    result = run_fast(planned_fast(few, folder), StudyHost())
    assert [(step.number, row.axis) for step, row in result.ordered] == [
        (number, axis) for number in range(1, 5) for axis in "xy"
    ]
    assert result.codes == ["completed"] * 4
    swings = [row.figures.peak_to_peak_um for _, row in result.ordered]
    assert swings[4] > 1.3 * swings[2]  # of x
    assert swings[5] == pytest.approx(swings[3], rel=0.1)
    assert result.drift is not None
    rows = [*csv.DictReader(result.tables[0].read_text().splitlines())]
    assert [row["axis"] for row in rows] == [*"xy"] * 4
    names = [f"few-000{number}.{axis}.mcap" for number in range(1, 5) for axis in "xy"]
    assert [row["recording"] for row in rows] == names
    again = planned_fast(few, folder)
    assert again.left == ()
    assert [row.kept for row in run_fast(again, StudyHost()).rows.values()] == [True] * 4
    (folder / "few-0002.y.mcap").unlink()
    assert [each.step.number for each in planned_fast(few, folder).left] == [2]
    rig = Rig()
    plan = planned_in_real_time(few, folder, rig.now())
    done = run_series(plan, replace(rig.host, run=unpaced))
    assert done.codes == ["completed"] * 4
    assert rig.rows.count((2, "completed", False)) == 2


def test_a_fault_of_the_rig_ends_it(campaign, tmp_path):
    text = CAMPAIGN + "  device.fault: [null, {kind: sensor_nan, at_sample: 100}]\n"
    result = run_fast(planned_fast(campaign(text), tmp_path), StudyHost())
    assert [row.code for _, row in result.ordered][:3] == ["completed", "fault", "planned"]
    assert "is no valid reading" in result.reason
    assert read(tmp_path / result.rows[2].recording).end["code"] == "fault"


def test_only_simulated_devices(campaign, tmp_path, monkeypatch):
    device = SimpleNamespace(info=SimpleNamespace(simulated=False, name="modbus_dac"))
    step = SimpleNamespace(step=campaign().steps[0], loaded=[SimpleNamespace(device=device)])
    monkeypatch.setattr(
        "hilctl.lab.studies.campaign.campaign_runner.planned",
        lambda *_: CampaignPlan(campaign(), tmp_path, (step,), 1.0),
    )
    with pytest.raises(InputError, match=r"--fast: step 1 .*modbus_dac"):
        planned_fast(campaign(), tmp_path)
