"""Parallel simulation: the same table on every scheduler."""

import importlib.util
from types import SimpleNamespace

import pytest

from hilctl.base.errors import InputError
from hilctl.recording.reader import read
from hilctl.studies.campaign.campaign_runner import StudyHost
from hilctl.studies.campaign.parallel_simulation import planned_fast, run_fast
from hilctl.studies.campaign.plan import CampaignPlan
from tests.unit.studies.campaign.conftest import CAMPAIGN

BUDGET = "set: {limits.rms_current_a: 1.3, limits.thermal_time_constant_s: 2.0}\n"


def tables(result):
    return [path.read_bytes() for path in result.tables]


def test_a_campaign_resumes(campaign, tmp_path):
    few = campaign(CAMPAIGN + BUDGET)
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

    few = campaign(CAMPAIGN + BUDGET)
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


def test_a_fault_of_the_rig_ends_it(campaign, tmp_path):
    text = CAMPAIGN + "  device.fault: [null, {kind: sensor_nan, at_sample: 100}]\n"
    result = run_fast(planned_fast(campaign(text), tmp_path), StudyHost())
    assert [row.code for _, row in result.ordered][:3] == ["completed", "fault", "planned"]
    assert "displacement nan µm" in result.reason
    assert read(tmp_path / result.rows[2].recording).end["code"] == "fault"


def test_only_simulated_devices(campaign, tmp_path, monkeypatch):
    device = SimpleNamespace(info=SimpleNamespace(simulated=False, name="modbus_dac"))
    step = SimpleNamespace(step=campaign().steps[0], loaded=SimpleNamespace(device=device))
    monkeypatch.setattr(
        "hilctl.studies.campaign.parallel_simulation.planned",
        lambda *_: CampaignPlan(campaign(), tmp_path, (step,), 1.0),
    )
    with pytest.raises(InputError, match=r"--fast: step 1 .*modbus_dac"):
        planned_fast(campaign(), tmp_path)
