"""The table of a campaign, read back."""

import pytest

from hilctl.base.errors import DataError, InputError
from hilctl.studies.campaign.steps import CampaignStep
from hilctl.studies.campaign.table import CampaignRow, columns_of, csv_text, entry_of
from hilctl.studies.multi_run.columns import find_table, read_entries
from hilctl.studies.multi_run.run_figures import RunFigures

POINT = {"waveform.amplitude": 0.1 + 0.2, "compensator": {"model": "a,b.yaml"}, "note": 'say "x"\n'}
DONE = CampaignRow(
    "completed", RunFigures(loop_area=1.0 / 3.0, deadline_misses=2), "few-0002.mcap", "completed"
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


def test_other_tables_are_none(rows, tmp_path):
    (tmp_path / "notes.csv").write_text("a,b\n1,2\n")
    (tmp_path / "bytes.csv").write_bytes(b"\xff\xfe")
    assert find_table(tmp_path) is None
    for name in ("one", "two"):
        write(tmp_path / f"{name}.csv", rows)
    with pytest.raises(InputError, match=r"several campaigns: one\.csv, two\.csv"):
        find_table(tmp_path)


def test_a_broken_row_is_said_with_its_line(rows, tmp_path):
    path = write(tmp_path / "few.csv", rows)
    path.write_text(path.read_text().replace("\n2,3,False", "\nx,3,False"))
    with pytest.raises(DataError, match=r"few\.csv:\d: is no row of a campaign's table"):
        read_entries(path)
