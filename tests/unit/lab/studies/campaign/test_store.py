"""Default folder and table of a campaign."""

import csv
import os
from dataclasses import replace

import pytest

from hilctl.base.errors import ConfigError, InputError
from hilctl.lab.studies.campaign import store
from hilctl.lab.studies.campaign.plan import planned
from hilctl.lab.studies.campaign.store import CampaignRow, write_table
from hilctl.lab.studies.multi_run.digest import FIGURES, RunValues
from tests.unit.lab.studies.campaign.conftest import CAMPAIGN


def test_default_folder(campaign):
    assert str(store.campaign_folder(campaign())) == "recordings/few"
    assert str(store.campaign_folder(campaign(CAMPAIGN, "recording.folder=/lab"))) == "/lab/few"
    assert (
        str(store.campaign_folder(campaign(CAMPAIGN + "set: {recording: {folder: day}}")))
        == "day/few"
    )
    assert str(store.campaign_folder(campaign(CAMPAIGN + "folder: /there"))) == "/there"
    few = campaign()
    few.experiment.unlink()
    with pytest.raises(ConfigError, match=r"few.yaml:2: experiment: "):
        store.campaign_folder(few)


DONE = CampaignRow("completed", RunValues(peak_to_peak_um=0.1 + 0.2), "few-0001.mcap", "completed")


@pytest.fixture
def plan(campaign, tmp_path):
    text = CAMPAIGN.replace("waveform.frequency_hz: [10.0, 20.0]", "compensator: [none]")
    return planned(campaign(text + "reference_run: {every: 9}"), tmp_path, {}, 0.0)


def read_back(path):
    with path.open(newline="", encoding="utf-8") as stream:
        return list(csv.DictReader(stream))


def test_every_step_is_a_row_whether_it_was_run_or_not(plan):
    """Numbers read back bit for bit; missing values are empty."""
    paths = write_table(plan, {1: DONE})
    rows = read_back(paths[0])
    assert paths[0].name == "few.csv"
    first = ["step", "repeat", "reference_run", "waveform.amplitude", "compensator"]
    assert list(rows[0])[:5] == first
    assert [name for name in rows[0] if name in FIGURES] == list(FIGURES)
    assert float(rows[0]["peak_to_peak_um"]) == 0.1 + 0.2
    assert rows[0]["loop_area"] == ""
    assert [row["result"] for row in rows] == ["completed", "planned", "planned", "planned"]
    assert [row["waveform.amplitude"] for row in rows] == ["", "1.0", "2.0", ""]
    assert rows[1]["compensator"] == "none"


def test_a_full_disk_leaves_the_old_table(plan, monkeypatch):
    path = write_table(plan, {})[0]
    before = path.read_bytes()

    def fail(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", fail)
    with pytest.raises(InputError, match="No space left"):
        write_table(plan, {1: DONE})
    assert path.read_bytes() == before
    assert [each.name for each in path.parent.glob(".few*")] == []


def test_parquet_has_the_same_and_its_facts(plan):
    parquet = pytest.importorskip("pyarrow.parquet")
    csv_path, path = write_table(plan, {1: DONE, 2: replace(DONE, result="fault: x")})
    table = parquet.read_table(path)
    assert table.column("peak_to_peak_um").to_pylist() == [0.1 + 0.2] * 2 + [None] * 2
    assert table.column("waveform.amplitude").to_pylist() == [None, 1.0, 2.0, None]
    assert table.schema.metadata[b"hilctl.campaign"] == b"few"
    assert table.column_names == list(read_back(csv_path)[0])
