"""What a run hands to those who show it: complete, and fixed."""

from dataclasses import fields
from pathlib import Path

from hilctl.cli.run import run_mapping
from hilctl.run.result import RunResult

RESULT = RunResult(
    path=Path("a.mcap"), code="stopped", reason="by a test", output_state="unknown", stop_signal=15,
    samples=90, missing=10, late_ticks=3, deadline_misses="2 of 5",
)  # fmt: skip


def test_programs_get_every_figure_of_a_run_too_long_to_report():
    mapping = run_mapping(RESULT, None)
    told = {"a.mcap", "stopped", "by a test", False, "unknown", 90, 10, "2 of 5"}
    assert mapping.pop("adapted") == {}
    assert set(mapping.values()) == told
    assert len(mapping) == len(fields(RunResult)) - 2
