"""What came out, for programs."""

import json
import math
from dataclasses import replace

from hilctl.series.result import series_mapping


def test_it_is_plain_and_has_runs_trends_and_failures(crossed):
    odd = replace(crossed.runs[0].figures, rms_error_percent=math.inf)
    runs = (
        replace(crossed.runs[0], figures=odd),
        replace(crossed.runs[1], result="fault: x"),
        *crossed.runs[2:],
    )
    found = json.loads(json.dumps(series_mapping(replace(crossed, runs=runs)), allow_nan=False))
    assert found["headline"].startswith("5 of 6 runs completed, 1 failed")
    assert [each["key"] for each in found["varied"]] == list(crossed.keys)[::-1]
    assert found["failed"] == [2]
    assert found["runs"][0]["rms_error_percent"] is None
    assert found["runs"][2]["values"]["waveform.frequency_hz"] == 200.0
    assert {trend["figure"] for trend in found["trends"]} == {
        "loop_area",
        "peak_hysteresis_percent",
    }
