"""Runs of a folder, of files, and of a campaign's table."""

import shutil
from dataclasses import replace
from pathlib import Path

import pytest

from hilctl.base.errors import DataError, InputError
from hilctl.lab.studies.campaign.steps import CampaignStep
from hilctl.lab.studies.campaign.store import CampaignRow, columns_of, csv_text, entry_of
from hilctl.lab.studies.multi_run import collect as module
from hilctl.lab.studies.multi_run.collect import collect, find_table, read_entries
from hilctl.lab.studies.multi_run.digest import RunValues

POINT = {"waveform.amplitude": 0.1 + 0.2, "compensator": {"model": "a,b.yaml"}, "note": 'say "x"\n'}
DONE = CampaignRow(
    "completed", RunValues(loop_area=1.0 / 3.0, deadline_misses=2), "few-0002.mcap", "completed"
)


@pytest.fixture
def rows():
    return [(CampaignStep(1, {}, 1, True, ()), CampaignRow("fault: no, really")),
            (CampaignStep(2, POINT, 3, False, ()), DONE)]  # fmt: skip


def write(path, rows):
    path.write_text(csv_text(columns_of(tuple(POINT), rows)), encoding="utf-8")
    return path


def test_what_a_campaign_writes_reads_back_the_same(rows, tmp_path):
    path = write(tmp_path / "few.csv", rows)
    found = read_entries(path)
    assert found[1] == entry_of(*rows[1])
    assert found[0].values == dict.fromkeys(POINT)
    assert (found[0].is_reference, found[0].result) == (True, "fault: no, really")
    assert find_table(tmp_path) == path


def test_metrics_that_are_no_longer_computed_were_not_varied(rows, tmp_path):
    columns = columns_of(tuple(POINT), rows)
    more = {"offset_um": {"offset_um": [None, None], "minor_low_um": [None, 3.0]}}
    before = {}
    for name, values in columns.items():
        before |= more.get(name, {name: values})
    path = tmp_path / "few.csv"
    path.write_text(csv_text(before), encoding="utf-8")
    assert read_entries(path)[1].values.keys() == POINT.keys()


def test_failed_and_remaining_runs_are_counted(crossed):
    broken = replace(crossed.runs[2], result="fault: the coil is hot")
    later = replace(crossed.runs[5], result="planned")
    series = replace(crossed, runs=(*crossed.runs[:2], broken, *crossed.runs[3:5], later))
    assert series.headline.startswith("4 of 6 runs")
    assert "1 failed: 200 Hz, 3 A (fault: the coil is hot), 1 remaining" in series.headline


def test_other_tables_are_none(rows, tmp_path):
    (tmp_path / "notes.csv").write_text("a,b\n1,2\n")
    (tmp_path / "bytes.csv").write_bytes(b"\xff\xfe")
    assert find_table(tmp_path) is None
    for name in ("one", "two"):
        write(tmp_path / f"{name}.csv", rows)
    with pytest.raises(InputError, match=r"one\.csv, two\.csv"):
        find_table(tmp_path)


def test_a_broken_row_is_said_with_its_line(rows, tmp_path):
    path = write(tmp_path / "few.csv", rows)
    path.write_text(path.read_text().replace("\n2,3,False", "\nx,3,False"))
    with pytest.raises(DataError, match=r"few\.csv:\d: "):
        read_entries(path)


GOLDEN = Path(__file__).parents[5] / "recordings" / "golden"
RUNS = (GOLDEN / "terfenol_uncompensated.mcap",)


@pytest.fixture
def folder(tmp_path):
    return Path(shutil.copytree(GOLDEN, tmp_path / "runs"))


def test_files_are_told_apart_by_their_experiments():
    told = []
    series = collect(
        sorted(GOLDEN.glob("*uncompensated.mcap")) * 2, None, lambda *a: told.append(a)
    )
    assert [run.number for run in series.runs] == [1, 2]
    assert series.dimensions == ()
    assert [series.text(run) for run in series.runs] == ["run 1", "run 2"]
    assert told[1] == (0.5, "read terfenol_uncompensated.mcap")


def test_a_folder_without_a_table_gives_all_that_can_be_read(folder):
    (folder / "zz.mcap").write_text("no recording")
    (folder / "folder.mcap").mkdir()
    series = collect([folder])
    assert len(series.runs) == len(list(GOLDEN.glob("*.mcap")))
    assert len(series.missing) == 1
    assert "zz.mcap" in series.missing[0]


def test_a_campaign_s_table_says_what_varied_and_what_failed(folder):
    figures = RunValues(peak_hysteresis_percent=20.0)
    steps = [CampaignStep(n, {"waveform.amplitude": float(n)}, 1, False, ()) for n in (1, 2, 3)]
    name = "terfenol_uncompensated.mcap"
    rows = [
        (steps[0], CampaignRow("completed", figures, name, "completed")),
        (steps[1], CampaignRow("completed", figures, "../lost.mcap", "completed")),
        (steps[2], CampaignRow("fault: hot", code="fault")),
    ]
    (folder / "few.csv").write_text(csv_text(columns_of(("waveform.amplitude",), rows)))
    series = collect([folder])
    assert (series.name, series.is_campaign) == ("few", True)
    assert series.keys == ("waveform.amplitude",)
    assert series.runs[0].digest.name == "terfenol_sine_6a_uncompensated"
    # A recording is in the table's folder, whatever the table says.
    assert series.missing == (f"{folder / 'lost.mcap'}: no such file",)
    assert [run.number for run in series.failed] == [3]
    assert series.planned == 0


def test_what_was_named_must_be_there(folder, tmp_path):
    with pytest.raises(DataError, match="no such file"):
        collect([tmp_path / "none.mcap"])
    with pytest.raises(InputError, match="one folder"):
        collect([folder, RUNS[0]])
    empty = tmp_path / "empty"
    empty.mkdir()
    with pytest.raises(InputError, match="no recordings"):
        collect([empty])


def test_a_recording_too_long_for_memory_is_left_out_and_named(folder, monkeypatch):
    monkeypatch.setattr(module, "MOST_BYTES", 180_000)
    short = [path for path in folder.glob("*.mcap") if path.stat().st_size <= module.MOST_BYTES]
    series = collect([folder])
    assert len(series.runs) == len(short) > 0
    assert all("hilctl report" in text for text in series.missing)
    assert len(series.missing) == len(list(folder.glob("*.mcap"))) - len(short) > 0


def test_a_recording_without_an_end_is_not_completed(monkeypatch):
    found = module.read
    monkeypatch.setattr(module, "read", lambda path: replace(found(path), end={}))
    series = collect([RUNS[0]])
    assert series.runs[0].result.startswith("truncated")
    assert series.done == ()
