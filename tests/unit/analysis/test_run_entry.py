"""What is known of a recording from both its ends, as plain values."""

import json
from pathlib import Path

import pytest
from mcap.writer import Writer

from hilctl.analysis.report import summarize
from hilctl.analysis.run_entry import COLUMNS, entry_of, unreadable
from hilctl.recording.facts import END_FIGURES, HOLDS_FACT, LABELS_FACT, RECORDINGS
from hilctl.recording.reader import read

GOLDEN = Path(__file__).parents[3] / "recordings" / "golden" / "terfenol_compensated.mcap"
RUN = {
    "name": "made",
    "simulated": "true",
    "sample_rate_hz": "1000.0",
    LABELS_FACT: '{"sample": "A7", "t": 21.5}',
    HOLDS_FACT: "[]",
    "device": "dac",
    "device.load_kg": "3.7",
    "device.serial": "0012",
    "device.noise": "True",
    "device.creep": "None",
    "device.nan": "NaN",
    "device.list": "[1]",
    "waveform.kind": "sine",
    "segments": json.dumps(
        [
            {"label": f"sine {k}", "start": 100 * k, "stop": 100 * k + 100, "period": period,
             "steady_start": 100 * k, "steady_stop": 100 * k + 100}
            for k, period in enumerate((10.0, 0.0, 4.0))
        ]
    ),
}  # fmt: skip
END = {
    "code": "completed",
    "output_safe": "false",
    "recorded_samples": "290",
    "missing_samples": "10",
    "late_ticks": "-1",
    "skipped_ticks": "3",
    "peak_error_percent": "0.5",
    "loop_area": "inf",
    "rms_error_percent": "x",
}


def entry(tmp_path, run, end):
    path = tmp_path / RECORDINGS
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start("", "")
        writer.add_metadata("hilctl.run", run)
        if end:
            writer.add_metadata("hilctl.end", end)
        writer.finish()
    return entry_of(path, "sub/a.mcap", 7, 8)


def test_facts_become_values(tmp_path):
    """Numbers and truth values where facts say so; what is damaged is not known."""
    found = entry(tmp_path, RUN, END)
    assert list(found) == list(COLUMNS)
    assert json.loads(found.pop(LABELS_FACT)) == {"sample": "A7", "t": 21.5}
    assert json.loads(found.pop("options")) == {
        "device.load_kg": 3.7,
        "device.serial": "0012",
        "device.noise": True,
        "device.nan": "NaN",
        "device.list": "[1]",
        "waveform.kind": "sine",
    }
    assert {name: value for name, value in found.items() if value is not None} == {
        "path": "sub/a.mcap",
        "size_bytes": 7,
        "mtime_ns": 8,
        "state": "finished",
        "name": "made",
        "device": "dac",
        "simulated": True,
        "sample_rate_hz": 1000.0,
        "waveform": "sine 0 and 2 more",
        "frequency_hz": 250.0,
        "duration_s": 0.3,
        "code": "completed",
        "output_safe": False,
        "recorded_samples": 290,
        "missing_samples": 10,
        "skipped_ticks": 3,
        "peak_error_percent": 0.5,
    }
    for name, value in found.items():
        assert value is None or type(value) is COLUMNS[name]


def test_a_recording_agrees_with_its_report():
    found, report = entry_of(GOLDEN, "a.mcap", 1, 2), summarize(read(GOLDEN)).to_mapping()
    same = {"name", "device", "reason", "sample_rate_hz", "recorded_samples", "skipped_ticks"}
    assert {name: found[name] for name in same} == {name: report[name] for name in same}
    assert found["waveform"] == report["segments"][0]["label"]
    assert found["frequency_hz"] == report["segments"][0]["frequency_hz"]
    assert set(END_FIGURES) <= report.keys()


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        ({LABELS_FACT: "3"}, "metadata hilctl.run: labels must be texts and numbers by name"),
        ({"segments": "[{}]"}, "metadata hilctl.run: segments: 0.label: Field required"),
    ],
)
def test_a_recording_that_nobody_can_read_says_why(tmp_path, change, problem):
    """It is what every other command says of it."""
    found = entry(tmp_path, {**RUN, **change}, END)
    assert found["state"] == "unreadable"
    assert found["problem"].startswith(problem)


def test_what_is_no_recording_has_its_place_and_its_problem(tmp_path):
    (tmp_path / "a").write_text("hello")
    found = entry_of(tmp_path / "a", "a.mcap", 5, 6)
    assert found == unreadable("a.mcap", 5, 6, "is not an MCAP file, or its start is lost")
    assert list(found) == list(COLUMNS)
