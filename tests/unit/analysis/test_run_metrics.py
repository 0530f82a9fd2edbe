"""The figures of a report as plain values for programs."""

import json
import math
from dataclasses import replace
from pathlib import Path

import pytest

from hilctl.analysis.report import summarize
from hilctl.analysis.run_metrics import quality_rows, run_rows, segment_table, usage_text
from hilctl.machine.procfs import ProcessUsage
from hilctl.recording.reader import read

GOLDEN = Path(__file__).parents[3] / "recordings" / "golden" / "terfenol_compensated.mcap"


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_nonfinite_metrics_are_null(value):
    report = summarize(read(GOLDEN))
    first = replace(report.segments[0], peak_error_percent=value)
    broken = replace(
        report, loop_area=value, segments=(first,), lateness_us={"p50": value, "max": 3.0}
    )
    plain = json.loads(json.dumps(broken.to_mapping(), allow_nan=False))
    assert plain["loop_area"] is None
    assert plain["segments"][0]["peak_error_percent"] is None
    assert plain["lateness_us"] == {"p50": None, "max": 3.0}
    assert plain["samples"] == report.samples


@pytest.fixture
def report():
    return summarize(read(GOLDEN))


def test_unknown_figures_are_dashes(report):
    unknown = replace(
        report, command_min=None, command_max=None, late_ticks=None, skipped_ticks=None,
        lateness_us={}, device="", reason="", simulated=False, complete=True,
    )  # fmt: skip
    rows = dict(run_rows(unknown))
    assert rows["command"] == "-"
    assert rows["ticks"] == "- late, - skipped"
    assert rows["lateness"] == "-"
    assert "timing" not in rows
    assert dict(run_rows(replace(report, deadline_misses="3 of 5")))["timing"] == "3 of 5"
    assert (rows["device"], rows["ended"]) == ("-", "-")
    assert dict(run_rows(replace(report, device_description="X 1")))["device description"] == "X 1"
    assert dict(run_rows(replace(unknown, complete=False)))["ended"] == "- (NOT complete)"


def test_uncompensated_runs_have_no_errors(report):
    assert any("error" in name for name, _ in quality_rows(report))
    plain = summarize(read(GOLDEN.with_name("terfenol_uncompensated.mcap")))
    assert not any("error" in name for name, _ in quality_rows(plain))


def test_empty_columns_are_omitted(report):
    segment = report.segments[0]
    blank = replace(segment, frequency_hz=None)
    headings, rows = segment_table(replace(report, segments=(segment, blank)))
    assert "freq. Hz" in headings
    assert rows[1][headings.index("freq. Hz")] == "-"
    headings, rows = segment_table(replace(report, segments=(blank,)))
    assert "freq. Hz" not in headings
    assert len(rows[0]) == len(headings)


def test_usage_is_shown_in_megabytes_and_seconds():
    text = usage_text(ProcessUsage(98_000_000, 1_500_000_000, 12, 3, 1234))
    for part in ("98 MB", "1.50 s", "15 ", "3 from", "1,234 "):
        assert part in text
