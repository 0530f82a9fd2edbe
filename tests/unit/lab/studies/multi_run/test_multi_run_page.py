"""Page and JSON of many runs."""

import json
import math
from dataclasses import replace

import pytest

from hilctl.lab.studies.multi_run.multi_run_page import (
    run_table,
    series_mapping,
    series_page,
    write_series,
)
from tests.unit.lab.studies.multi_run.conftest import digest

pytestmark = pytest.mark.usefixtures("undrawn")


def test_what_came_out_stands_first(crossed, tmp_path):
    write_series(crossed, tmp_path / "loops.html")
    page = (tmp_path / "loops.html").read_text(encoding="utf-8")
    assert page.index("6 of 6 runs") < page.index("<svg ")
    assert page.count("<figure") == 4
    assert "Linear fits" in page
    assert "1.0000" in page


def test_failures_and_what_can_t_be_read_are_marked(crossed):
    broken = replace(crossed.runs[0], result="fault: <b>hot</b>", digest=None)
    series = replace(crossed, runs=(broken, *crossed.runs[1:]), missing=("x.mcap: torn",))
    page = series_page(series)
    assert "x.mcap: torn</p>" in page
    assert "fault: &lt;b&gt;hot&lt;/b&gt;" in page
    assert "<b>hot" not in page


def test_the_table_has_a_column_for_what_varied_and_for_what_came_out(crossed):
    headings, rows = run_table(crossed, 4)
    assert headings == [
        "run", "frequency, Hz", "amplitude, A", "peak-to-peak, µm", "peak hysteresis, %",
        "loop area, µm·A", "result", "recording",
    ]  # fmt: skip
    assert rows[1] == ["2", "100", "3", "30.0", "20.0", "210", "completed", "run-2.mcap"]
    assert len(rows) == 4
    short, _ = run_table(crossed, 4, short=True)
    assert short == ["run", "frequency, Hz", "amplitude, A", "p-p µm", "hyst. %", "area"]


def test_labels_and_simulation_are_said(crossed):
    made = digest(labels={"operator": "Ada"}, simulated=True)
    runs = tuple(replace(run, digest=made) for run in crossed.runs)
    page = series_page(replace(crossed, runs=runs))
    assert "<th>operator</th><td>Ada</td>" in page
    assert "simulated" in page


def test_it_is_plain_and_has_runs_trends_and_failures(crossed):
    odd = replace(crossed.runs[0].figures, rms_error_percent=math.inf)
    runs = (
        replace(crossed.runs[0], figures=odd),
        replace(crossed.runs[1], result="fault: x"),
        *crossed.runs[2:],
    )
    found = json.loads(json.dumps(series_mapping(replace(crossed, runs=runs)), allow_nan=False))
    assert found["headline"].startswith("5 of 6 runs")
    assert [each["key"] for each in found["varied"]] == list(crossed.keys)[::-1]
    assert found["failed"] == [2]
    assert found["runs"][0]["rms_error_percent"] is None
    assert found["runs"][2]["values"]["waveform.frequency_hz"] == 200.0
    trends = {trend["figure"] for trend in found["trends"]}
    assert trends == {"loop_area", "peak_hysteresis_percent"}
