"""One run's row, and what of learning goes to programs."""

import json
from pathlib import Path

import numpy as np
import pytest

from hilctl.base.segments import Segment
from hilctl.experiment.correction import Correction, LearnedCycle
from hilctl.ilc.cycle import CycleScore
from hilctl.ilc.results import IlcResult, row_of
from hilctl.ilc.update import IlcState

RATE_HZ = 10_000.0
SEGMENT = Segment("sine", 0, 5000, 0, 5000, 100.0)
ERROR = CycleScore(
    harmonics_um=np.zeros(4, dtype=complex), noise_um=np.zeros(4), step_hz=100.0, cycles=16,
    peak_um=2.0, rms_um=0.5, peak_to_peak_um=50.0, floor_um=0.1, strongest_hz=100.0,
    answer=1.0 + 0.0j,
)  # fmt: skip
STATE = IlcState(RATE_HZ, 1250.0, np.zeros(4, dtype=complex))
ROW = row_of(3, SEGMENT, ERROR, STATE, 800.0, Path("run-03.mcap"))


def test_a_row_is_in_percent_of_the_peak_to_peak_displacement():
    assert (ROW.run, ROW.label, ROW.cycles, ROW.recording) == (3, "sine", 16, "run-03.mcap")
    assert ROW.rms_percent == pytest.approx(1.0)
    assert ROW.error_percent == pytest.approx(4.0)
    assert ROW.delay_samples == pytest.approx(STATE.response.delay_s * RATE_HZ)


def test_programs_get_figures_without_coefficients():
    cycle = LearnedCycle.from_coefficients(
        "sine", 100.0, np.zeros(64), np.ones(50, dtype=complex), start_percent=4.0,
        error_percent=0.5,
    )  # fmt: skip
    correction = Correction(sample_rate_hz=RATE_HZ, model_sha256="0" * 64, cycles=(cycle,))
    mapping = IlcResult(correction, (ROW, ROW), (ROW,), "done").to_mapping()
    text = json.dumps(mapping, allow_nan=False)
    assert "cosine" not in text
    assert mapping["waveforms"] == [{"label": "sine", "start_percent": 4.0, "error_percent": 0.5}]
    assert mapping["reason"] == "done"
