"""Campaign folder and its table."""

import csv
import os
from dataclasses import replace

import pytest

from hilctl.base.errors import ConfigError, InputError
from hilctl.base.files import TextFiles
from hilctl.experiment.preflight import check
from hilctl.lab.studies.campaign import store
from hilctl.lab.studies.campaign.plan import planned
from hilctl.lab.studies.campaign.store import CampaignRow, write_table
from hilctl.lab.studies.multi_run.digest import FIGURES, RunFigures
from hilctl.run.start import RunKey
from hilctl.run.unpaced import run_unpaced
from tests.unit.lab.studies.campaign.conftest import CAMPAIGN


def never(seconds):
    raise AssertionError(seconds)


@pytest.fixture
def recorded(campaign, tmp_path):
    """Record the first step of a campaign; return file and fingerprint."""
    few = campaign()
    loaded = few.load(few.steps[0], TextFiles())

    def make(name):
        run_unpaced(check(loaded), tmp_path / name)
        return tmp_path / name, RunKey.of(loaded)

    return make


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


def test_one_campaign_at_a_time(tmp_path):
    folder, waits = tmp_path / "runs", []
    with store.locked_folder(folder, never):
        with (
            pytest.raises(InputError, match="another campaign"),
            store.locked_folder(folder, waits.append),
        ):
            pass
        assert 3.0 < sum(waits) < 10.0
    with store.locked_folder(folder, never):
        pass
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="created"), store.locked_folder(tmp_path / "file", never):
        pass


def test_a_refusal_leaves_no_folder_that_it_has_made(tmp_path):
    """A rejected campaign removes its new folders only."""
    (tmp_path / "mine").mkdir()
    for name in ("mine", "new/deep"):
        with pytest.raises(InputError, match="wrong"), store.locked_folder(tmp_path / name, never):
            raise InputError("wrong")
    assert [each.name for each in tmp_path.iterdir()] == ["mine"]


def test_only_completed_runs_count_and_truncated_ones_are_repaired(recorded, tmp_path):
    path, key = recorded("a.mcap")
    again, _ = recorded("b.mcap")
    content, torn = path.read_bytes(), tmp_path / "torn.mcap"
    torn.write_bytes(content[: len(content) // 2])
    (tmp_path / "text.mcap").write_text("no recording")
    assert store.completed_runs(tmp_path) == {key: [path, again]}
    assert store.last_started(tmp_path) == again
    assert [text.startswith(f"{torn}: ") for text in store.repair_recordings(tmp_path)] == [True]
    assert store.repair_recordings(tmp_path) == []
    assert store.completed_runs(tmp_path) == {key: [path, again]}
    assert store.last_started(tmp_path / "absent") is None


def test_files_of_runs_that_never_started_are_moved(recorded, tmp_path):
    """Empty files are removed, incomplete headers renamed, other files kept."""
    path, _ = recorded("a.mcap")
    (tmp_path / "empty.mcap").touch()
    (tmp_path / "head.mcap").write_bytes(path.read_bytes()[:20])
    (tmp_path / "text.mcap").write_text("no recording")
    assert len(store.repair_recordings(tmp_path)) == 2
    left = {each.name for each in tmp_path.iterdir() if each.suffix != ".yaml"}
    assert left == {"a.mcap", "head.mcap.torn", "text.mcap"}


def test_special_files_are_ignored(recorded, tmp_path):
    path, key = recorded("a.mcap")
    (tmp_path / "b.mcap").mkdir()
    os.mkfifo(tmp_path / "c.mcap")
    (tmp_path / "d.mcap").symlink_to("nowhere")
    (tmp_path / "e.mcap").symlink_to("b.mcap")
    assert store.repair_recordings(tmp_path) == []
    assert store.completed_runs(tmp_path) == {key: [path]}
    assert store.last_started(tmp_path) == path


def test_names_are_never_taken_twice(tmp_path):
    first = store.new_recording(tmp_path, "few", 7)
    assert first.name == "few-0007.mcap"
    first.symlink_to("nowhere")
    assert store.new_recording(tmp_path, "few", 7).name == "few-0007-2.mcap"


def test_a_run_that_records_there_is_waited_for(tmp_path, monkeypatch):
    """A run without a supervisor is awaited; a supervised one is an error."""

    class Run:
        card = type("Card", (), {"recording": str(tmp_path / "a.mcap"), "name": "a-1"})
        alive, supervised = True, False

    waits = []

    def wait(seconds):
        waits.append(seconds)
        Run.alive = len(waits) < 3

    monkeypatch.setattr("hilctl.lab.studies.campaign.store.runs", lambda: [Run])
    store.await_runs(tmp_path / "other", never)
    store.await_runs(tmp_path, wait)
    assert len(waits) == 3
    Run.alive = Run.supervised = True
    with pytest.raises(InputError, match="a-1"):
        store.await_runs(tmp_path, never)


DONE = CampaignRow("completed", RunFigures(peak_to_peak_um=0.1 + 0.2), "few-0001.mcap", "completed")


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
