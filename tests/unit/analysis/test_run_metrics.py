"""The figures of a report as plain values for programs."""

import json
import math
from dataclasses import replace
from pathlib import Path

import pytest

from hilctl.analysis.report import summarize
from hilctl.recording.reader import read

GOLDEN = Path(__file__).parents[3] / "recordings" / "golden" / "terfenol_compensated.mcap"


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_what_is_not_finite_becomes_null(value):
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
