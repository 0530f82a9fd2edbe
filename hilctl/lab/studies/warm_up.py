"""Warming up: repeat an experiment until its stroke no longer changes."""

from pathlib import Path

from hilctl.analysis.report import summarize
from hilctl.lab.studies.study import Study, StudyStep


def warmed_up(experiment: Path, within_percent: float = 0.1, most: int = 50) -> Study[int]:
    """Return the number of runs until two strokes in succession are equal within a tolerance."""
    before_um = 0.0
    for number in range(1, most + 1):
        run = yield StudyStep(experiment, text=f"warm-up run {number}")
        stroke_um = summarize(run.recording).peak_to_peak_um or 0.0
        if abs(stroke_um - before_um) <= 0.01 * within_percent * stroke_um:
            return number
        before_um = stroke_um
    return most
