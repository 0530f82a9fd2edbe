"""Studies of a user's own."""

import pytest

from hilctl import api
from tests.unit.api.test_runs import SHORT, SINE


def strokes(*amplitudes):
    found = {}
    for amplitude in amplitudes:
        run = yield api.StudyStep(SINE, {**SHORT, "waveform.amplitude": amplitude})
        found[amplitude] = run.kept, api.summarize(run.path).peak_to_peak_um
    return found


def test_a_study_resumes(tmp_path):
    shown = []
    first = api.study(
        strokes(0.5, 1.0), tmp_path / "runs", fast=True,
        on_progress=lambda done, text: shown.append(text),
    )  # fmt: skip
    assert first[0.5][1] < first[1.0][1]
    assert shown == ["step 1", "step 2"]
    again = api.study(strokes(1.0, 0.5), tmp_path / "runs", fast=True)
    assert again == {amplitude: (True, moved_um) for amplitude, (_, moved_um) in first.items()}


def test_an_invalid_first_step_leaves_no_folder(tmp_path):
    with pytest.raises(api.ConfigError, match="amplitude"):
        api.study(strokes(-1.0), tmp_path / "runs", fast=True)
    assert list(tmp_path.iterdir()) == []
