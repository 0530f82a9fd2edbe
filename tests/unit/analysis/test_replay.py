"""Replay: commands recomputed from a recording bit for bit, and refusals."""

from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from hilctl.analysis.replay import ErrorPrediction, replay
from hilctl.base.errors import DataError
from hilctl.base.samples import Flag
from hilctl.loop.compensator import Compensator
from hilctl.models.model_file import load_model, parse_model
from hilctl.recording import reader
from hilctl.recording.reader import RecordingStream, read
from hilctl.recording.recover import recover_recording

ROOT = Path(__file__).parents[3]
GOLDEN, CONFIGS = ROOT / "recordings" / "golden", ROOT / "configs"
OTHER = load_model(CONFIGS / "models" / "terfenol_rdpi.yaml")


@pytest.fixture(scope="module")
def recording():
    return read(GOLDEN / "terfenol_compensated.mcap")


@pytest.fixture
def damaged(tmp_path):
    """Return a file with a flipped bit in its middle."""
    data = bytearray((GOLDEN / "piezo_compensated.mcap").read_bytes())
    data[len(data) // 2] ^= 4
    path = tmp_path / "run.mcap"
    path.write_bytes(data)
    return path


def test_replay_omits_samples_after_a_gap(damaged):
    """After a damaged chunk the compensator's memory is not known; what is before it replays."""
    for recording in (read(damaged), read(recover_recording(damaged).path)):
        result = replay(recording)
        assert result.identical
        assert result.left_out_samples > 0
        assert result.samples + result.left_out_samples == recording.samples.index.size


def test_replay_is_identical_except_with_another_model(recording):
    same = replay(recording)
    assert (same.identical, same.first_difference, same.differing_samples) == (True, None, 0)
    assert same.samples == recording.samples.index.size
    assert same.predicted is None
    other = replay(recording, OTHER)
    assert not other.identical
    assert other.largest_difference >= other.rms_difference > 0.0
    assert other.predicted.rms_percent > other.predicted.recorded_rms_percent


def test_recording_with_timing_of_an_earlier_release_is_replayed(recording):
    text = recording.experiment_yaml + "timing: {late_policy: skip, grace_s: 0.5}\n"
    assert replay(replace(recording, experiment_yaml=text)).identical


def test_a_model_of_another_unit_is_refused(recording):
    piezo = load_model(CONFIGS / "models" / "piezo_ppi.yaml")
    with pytest.raises(DataError, match=r"commands in V"):
        replay(recording, piezo)


def test_one_flipped_bit_is_found_at_its_sample():
    recording = read(GOLDEN / "terfenol_uncompensated.mcap")
    samples = recording.samples
    command = samples.command.copy()
    command[1234] = np.nextafter(command[1234], np.inf)
    changed = replace(recording, samples=replace(samples, command=command))
    found = replay(changed)
    assert (found.first_difference, found.differing_samples) == (int(samples.index[1234]), 1)


def test_recording_without_a_compensator_is_refused():
    recording = read(GOLDEN / "terfenol_uncompensated.mcap")
    with pytest.raises(DataError, match="no compensator"):
        replay(recording, OTHER)
    with pytest.raises(DataError, match="no samples"):
        replay(replace(recording, starts=()))


def test_impossible_states_are_refused(recording):
    """States, commands and rates come from the file, and kernels work with them."""
    start = recording.starts[0]
    for state in (start.state[:-1], np.full_like(start.state, np.inf)):
        changed = replace(recording, starts=(replace(start, state=state),))
        with pytest.raises(DataError, match="/samples: sample 0"):
            replay(changed)
    command = np.full_like(recording.samples.command, np.nan)
    with pytest.raises(DataError, match="must be finite"):
        replay(replace(recording, samples=replace(recording.samples, command=command)))
    with pytest.raises(DataError, match="recorded at 1000"):
        replay(replace(recording, sample_rate_hz=1000.0))


def test_no_sample_is_replayed_twice():
    """A start without a gap ends the range before it, so that the work stays proportional."""
    recording = read(GOLDEN / "terfenol_uncompensated.mcap")
    start = recording.starts[0]
    starts = tuple(
        replace(start, sample=sample, previous_command=float(recording.samples.command[sample - 1]))
        for sample in range(100, 3000)
    )
    found = replay(replace(recording, starts=(start, *starts)))
    assert (found.identical, found.samples) == (True, recording.samples.index.size)


def pieces_of(recording, bounds):
    for a, b in pairwise([0, *bounds, recording.samples.index.size]):
        part = recording.samples.rows(slice(a, b))
        index = part.index if part.index.size else np.array([-1])
        starts = tuple(s for s in recording.starts if index[0] <= s.sample <= index[-1])
        yield replace(recording, samples=part, starts=starts)


@pytest.mark.parametrize(
    "name", ["terfenol_compensated", "piezo_compensated", "terfenol_uncompensated"]
)
@pytest.mark.parametrize("bounds", [[1], [777, 778, 2500], [0, 0, 4000], range(0, 5000, 333)])
def test_a_replay_in_pieces_is_that_of_the_whole(name, bounds):
    recording = read(GOLDEN / f"{name}.mcap")
    assert replay(pieces_of(recording, bounds)) == replay(recording)


@pytest.mark.parametrize("bounds", [[1], [777, 778, 2500], range(0, 5000, 333), range(0, 5000, 3)])
def test_another_model_looks_ahead_into_the_next_piece(recording, bounds):
    model = load_model(CONFIGS / "models" / "terfenol_staged.yaml")
    assert Compensator(model, recording.sample_rate_hz).preview > 3
    whole, parts = replay(recording, model), replay(pieces_of(recording, bounds), model)
    assert whole.rms_difference == pytest.approx(parts.rms_difference, rel=1e-12)
    assert whole.predicted.peak_percent == parts.predicted.peak_percent
    summed = {"rms_difference": 0.0, "predicted": None}
    assert replace(whole, **summed) == replace(parts, **summed)


@pytest.mark.parametrize("cut", range(0, 300, 50))
def test_gaps_at_the_ends_of_pieces(recording, cut):
    """After a gap only a start gives the memory, even at the end of a piece."""
    index = recording.samples.index
    kept = recording.samples.rows((index < 1000) | (index >= 1200))
    damaged = replace(recording, samples=kept)
    result = replay(pieces_of(damaged, [850 + cut]))
    assert result == replay(damaged)
    assert result.left_out_samples == index.size - 1200
    assert result.identical


def test_a_damaged_file_in_pieces(damaged, monkeypatch):
    whole = replay(read(damaged))
    monkeypatch.setattr(reader, "PIECE_SAMPLES", 1)
    assert len(list(RecordingStream(damaged))) > 3
    assert replay(RecordingStream(damaged)) == whole


def test_bypassed_samples_need_their_event():
    recording = read(GOLDEN / "terfenol_compensated.mcap")
    recording.samples.flags[500:600] |= np.uint32(Flag.INVERSE_OUT)
    with pytest.raises(DataError, match="/events: "):
        replay(recording)


def predicted(model, rate_hz, *pieces):
    prediction = ErrorPrediction(model, rate_hz)
    for samples in pieces:
        prediction.add(samples)
    return prediction.result()


def test_exact_model_predicts_no_error(recording):
    samples, rate_hz = recording.samples, recording.sample_rate_hz
    actuator = replace(samples, displacement_um=OTHER.forward(rate_hz).process(samples.command))
    found = predicted(OTHER, rate_hz, actuator)
    assert found.peak_percent == 0.0
    assert found.recorded_peak_percent > 1.0


def test_model_of_the_run_predicts_the_recorded_error(recording):
    """Except for the error of a rate-dependent inverse, about a tenth here."""
    model = parse_model("model.yaml", recording.model_yaml)
    found = predicted(model, recording.sample_rate_hz, recording.samples)
    assert found.rms_percent == pytest.approx(found.recorded_rms_percent, rel=0.2)


def test_in_pieces_it_is_that_of_the_whole(recording):
    samples, rate_hz = recording.samples, recording.sample_rate_hz
    parts = [samples.rows(slice(a, a + 777)) for a in range(0, samples.index.size, 777)]
    whole = predicted(OTHER, rate_hz, samples)
    in_parts = predicted(OTHER, rate_hz, *parts)
    assert in_parts.peak_percent == whole.peak_percent
    assert in_parts.rms_percent == pytest.approx(whole.rms_percent, rel=1e-12)


def test_without_readings_there_is_no_error(recording):
    samples = recording.samples
    lost = replace(samples, displacement_um=np.full(samples.index.size, np.nan))
    assert predicted(OTHER, recording.sample_rate_hz, lost) is None
    assert predicted(OTHER, recording.sample_rate_hz) is None
