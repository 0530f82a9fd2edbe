"""Campaigns without real time over several processes: the same as in one."""

from hilctl.lab.studies.campaign.campaign_runner import planned_fast, run_fast
from hilctl.lab.studies.campaign.steps import load_campaign
from hilctl.lab.studies.study import StudyHost
from hilctl.recording.reader import read
from tests.unit.lab.studies.campaign.conftest import CAMPAIGN, EXPERIMENT

BUDGET = "set: {limits.rms_current_a: 1.3, limits.thermal_time_constant_s: 2.0}\n"


def test_processes_give_the_table_of_one(tmp_path, monkeypatch):
    monkeypatch.setattr(
        "hilctl.lab.studies.campaign.campaign_runner.write_series",
        lambda _series, path: path.touch(),
    )
    (tmp_path / "rig.yaml").write_text(EXPERIMENT, encoding="utf-8")
    (tmp_path / "few.yaml").write_text(CAMPAIGN + BUDGET, encoding="utf-8")
    few = load_campaign(tmp_path / "few.yaml", ())
    found = {}
    for scheduler in ("none", "processes"):
        folder = tmp_path / scheduler
        folder.mkdir()
        result = run_fast(planned_fast(few, folder), StudyHost(), scheduler)
        assert result.count("completed") == 4
        samples = [read(path).samples for path in sorted(folder.glob("*.mcap"))]
        measured = [each.displacement_um.tobytes() for each in samples]
        found[scheduler] = [path.read_bytes() for path in result.tables[:1]], measured
    assert found["none"] == found["processes"]
