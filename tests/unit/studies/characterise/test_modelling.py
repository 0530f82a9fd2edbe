"""The model of a campaign, and its error on what no fit saw."""

from pathlib import Path

import numpy as np
import pytest

from hilctl.base.errors import DataError
from hilctl.base.segments import Segment
from hilctl.identify.data.records import History
from hilctl.models.plays import PpiModel
from hilctl.studies.characterise import modelling
from hilctl.studies.characterise.modelling import FITTED, JUDGED, held_out
from hilctl.studies.characterise.steps import STEPS

MODEL = PpiModel(
    direct=3.0, thresholds=(0.5,), weights=(2.0,), input_range=(-1.0, 1.0)
)  # fmt: skip
RATE_HZ = 1000.0


@pytest.fixture
def run(make_recording):
    """A conditioning cycle, then a reference that is judged between 600 and 1900."""

    def make(off_um=0.0, reach=1.0):
        command = reach * np.sin(np.arange(2000) ** 1.5 / 900.0)
        moved = MODEL.forward(RATE_HZ).process(command) + off_um
        segments = [Segment("decaying", 0, 500, 0, 500), Segment("random", 500, 2000, 600, 1900)]
        return make_recording(moved, command=command, segments=segments, sample_rate_hz=RATE_HZ)

    return make


def test_what_is_judged_is_not_fitted():
    names = [step.name for step in STEPS]
    assert set(JUDGED) <= set(names)
    assert set(FITTED) <= set(names)
    assert not set(FITTED) & set(JUDGED)


def test_a_perfect_model_has_no_error(run):
    found = held_out(MODEL, run(), 0.0, "random reference")
    assert found.peak_percent < 1e-9
    assert found.label == "random reference"
    assert (found.time_s[0], found.time_s.size) == (0.6, 1300)


def test_an_offset_is_an_error_and_is_told_apart(run):
    found = held_out(MODEL, run(-0.5), 0.0, "x")
    whole_um = np.ptp(found.measured_um)
    assert found.peak_percent == pytest.approx(50.0 / whole_um)
    assert found.mean_percent == pytest.approx(50.0 / whole_um)
    assert found.rms_percent == pytest.approx(50.0 / whole_um)


def test_the_floor_is_what_noise_makes(run):
    """Of 1300 normal values the largest is about 3.4 standard deviations."""
    found = held_out(MODEL, run(), 0.01, "x")
    assert found.floor_percent == pytest.approx(3.4 / np.ptp(found.measured_um), rel=0.05)


def test_commands_that_the_model_was_not_found_on_are_not_judged(run):
    assert held_out(MODEL, run(reach=1.5), 0.0, "x").time_s.size < 1000


def test_missing_samples_are_refused(make_recording, run):
    whole = run()
    short = make_recording(
        whole.samples.displacement_um[100:],
        command=whole.samples.command[100:],
        segments=whole.segments,
        index=np.arange(100, 2000),
        sample_rate_hz=RATE_HZ,
    )
    with pytest.raises(DataError, match="samples are missing or have no displacement"):
        held_out(MODEL, short, 0.0, "x")


def test_the_kind_is_chosen_on_whole_histories_of_what_may_be_fitted(run, monkeypatch):
    """Named by their files; to the end of the last waveform at full size, gaps filled in."""
    asked = []

    def identify(request):
        asked.append(request)
        return "found"

    monkeypatch.setattr(modelling, "identify_records", identify)
    monkeypatch.setattr(modelling, "read", lambda path: run())
    paths = {name: Path(f"{name}.mcap") for name in [*FITTED, *JUDGED, "growing-1"]}
    assert modelling.identified(paths) == "found"
    (request,) = asked
    records, settings, unit = request.records, request.settings, request.unit
    assert len(records) == len(request.source) == len(FITTED)
    assert (settings.auto, settings.whole, unit) == (True, True, "A")
    assert all(isinstance(record, History) for record in records)
    assert all(record.command.size == 1900 for record in records)
