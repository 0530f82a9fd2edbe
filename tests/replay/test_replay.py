"""Replay: the recorded reference, through the code that ran, gives the recorded bits again."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml

from hilctl.errors import DataError
from hilctl.models.base import HysteresisModel
from hilctl.models.files import dump_model
from hilctl.models.published import terfenol_rdpi
from hilctl.recording.data import Recording
from hilctl.recording.reader import read
from hilctl.replay import replay
from hilctl.start import start_run

GOLDEN = sorted((Path(__file__).parents[2] / "recordings" / "golden").glob("*.mcap"))


@pytest.fixture(scope="module")
def recording(tmp_path_factory) -> Recording:
    """A short compensated run that is stopped by its end, limits untouched."""
    folder = tmp_path_factory.mktemp("replay")
    (folder / "model.yaml").write_text(dump_model(terfenol_rdpi()))
    experiment = {
        "name": "replayed",
        "device": {"kind": "simulated_terfenol"},
        "sample_rate_hz": 20000,
        "block": 32,
        "waveform": {
            "kind": "sine",
            "unit": "um",
            "amplitude": 10.0,
            "frequency_hz": 40.0,
            "duration_s": 0.4,
            "soft_start_s": 0.05,
        },
        "compensator": {"model": "model.yaml"},
        "limits": {"peak_current_a": 4.0, "slew_a_per_s": 4000.0, "stroke_um": [-40.0, 40.0]},
    }
    path = folder / "experiment.yaml"
    path.write_text(yaml.safe_dump(experiment))
    result = start_run(path, [], folder / "run.mcap", False, lambda progress: None)
    assert result.code == "completed"
    return read(result.path)


def test_own_recording_is_identical(recording):
    """Every wanted command, command and flag comes out bit for bit, the ramp included."""
    result = replay(recording)
    assert result.identical
    assert result.samples == recording.samples.index.size > 8000
    assert result.first_difference is None


@pytest.mark.parametrize("row", [0, 777, 7999])
def test_one_changed_bit_is_found(recording, row):
    """A single last bit of a single command is noticed, with its place."""
    command = recording.samples.command.copy()
    command[row] = np.nextafter(command[row], np.inf)
    changed = replace(recording, samples=replace(recording.samples, command=command))
    result = replay(changed)
    assert not result.identical
    assert (result.first_difference, result.differing_samples) == (row, 1)


def test_every_stretch_replays_by_itself(recording):
    """With a gap in it, a recording replays on both sides of the gap from the recorded state."""
    start = recording.starts[0]
    cut = 3200
    model_state = _state_at(recording, cut)
    samples = recording.samples
    keep = np.r_[0:1600, cut : samples.index.size]
    parts = {
        name: getattr(samples, name)[keep] if getattr(samples, name).size else samples.measured
        for name in ("index", "reference_um", "wanted", "command", "measured",
                     "displacement_um", "flags")
    }  # fmt: skip
    gapped = replace(
        recording,
        samples=replace(samples, **parts),
        starts=(
            start,
            replace(
                start, sample=cut, state=model_state, previous_command=samples.command[cut - 1]
            ),
        ),
    )
    assert replay(gapped).identical


def _state_at(recording: Recording, sample: int):
    operator = terfenol_rdpi().inverse(recording.sample_rate_hz)
    operator.process(np.ascontiguousarray(recording.samples.reference_um[:sample]))
    return operator.state()


def test_another_model_says_what_it_would_have_done(recording):
    """A stiffer model asks for more current, and the difference is told."""
    half = terfenol_rdpi()
    softer: HysteresisModel = half.model_copy(
        update={"direct": half.direct / 1.1, "weights": tuple(w / 1.1 for w in half.weights)}
    )
    result = replay(recording, softer)
    assert not result.identical
    assert result.command_max == pytest.approx(1.1 * recording.samples.command.max(), rel=0.02)
    assert result.largest_difference > 0.1


def test_what_can_not_be_replayed_is_refused(recording):
    """No samples, or another model for a run without a reference: one clear message."""
    empty = replace(recording, starts=())
    with pytest.raises(DataError, match="holds no samples to replay"):
        replay(empty)
    with pytest.raises(DataError, match="had no compensator"):
        replay(replace(recording, compensated=False), terfenol_rdpi())


@pytest.mark.parametrize("path", GOLDEN, ids=lambda path: path.stem)
def test_golden_recordings_replay_bit_for_bit(path):
    """Recordings made by earlier versions still give the same bits."""
    result = replay(read(path))
    assert result.identical, result
    assert result.samples > 1000


def test_golden_recordings_are_there():
    """The folder is not empty: a compensated, an uncompensated and a voltage-driven run."""
    names = {path.stem for path in GOLDEN}
    assert names >= {"terfenol_compensated", "terfenol_uncompensated", "piezo_compensated"}
