"""The inverse bypassed and enabled during a run, at full stroke and 100 Hz, on a simulated rig."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from hilctl.analysis.replay import replay
from hilctl.base.errors import DataError
from hilctl.experiment.preflight import CheckedRun
from hilctl.loop.tuning import Tuning
from hilctl.recording import reader
from hilctl.recording.reader import RecordingStream, read
from hilctl.run import unpaced
from hilctl.run.start import checked_experiment
from hilctl.signals.cycle_metrics import fold, peak_hysteresis_percent

DEMO = Path(__file__).parents[2] / "configs" / "demo.yaml"
RATE_HZ = 50_000
OUT_S, IN_S, FADE_S = 1.0, 2.0, 0.25


class _Switched(unpaced.OfflineHost):
    """Bypasses and enables the inverse at given times of a run."""

    changes: Mapping[int, Tuning] = {}

    def heartbeat(self, next_sample, late_ticks):
        self._now = next_sample
        return super().heartbeat(next_sample, late_ticks)

    def tunings(self):
        return [(0, self.changes[self._now])] if self._now in self.changes else []


@pytest.fixture(scope="module")
def switched(tmp_path_factory):
    settings = ["waveform.frequency_hz=100", "waveform.duration_s=3.0"]
    checked = checked_experiment(DEMO, settings)
    line, samples = checked.forecast.line, round(FADE_S * RATE_HZ)
    changes = {
        round(at_s * RATE_HZ): Tuning(1.0, 0.0, samples, share, line)
        for at_s, share in ((OUT_S, 0.0), (IN_S, 1.0))
    }
    output = tmp_path_factory.mktemp("inverse") / "run.mcap"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(_Switched, "changes", changes)
        patch.setattr(unpaced, "OfflineHost", _Switched)
        assert unpaced.run_unpaced(CheckedRun((checked,)), output).code == "completed"
    return read(output), checked


def figures(recording, from_s):
    """Return peak hysteresis in percent and stroke in um of a fifth of a second."""
    part = recording.samples.part(round(from_s * RATE_HZ), round((from_s + 0.2) * RATE_HZ))
    signals = np.array((part.reference_um, part.displacement_um))
    cycle = fold(part.index, RATE_HZ / 100.0, signals).signals
    return peak_hysteresis_percent(*cycle), np.ptp(cycle[1])


def test_bypassed_inverse_is_enabled_again(switched):
    recording, _ = switched
    (before, stroke_um), (out, stroke_out_um), (back, _) = (
        figures(recording, at_s) for at_s in (0.6, OUT_S + 0.5, IN_S + 0.5)
    )
    assert before < 1.0
    assert out == pytest.approx(30.0, abs=2.0)
    assert stroke_out_um == pytest.approx(stroke_um, rel=0.01)
    assert back < 1.0


def test_no_step_is_beyond_the_slew_and_it_replays_bit_for_bit(switched):
    recording, checked = switched
    samples = recording.samples
    step = np.abs(np.diff(samples.command)).max() * RATE_HZ
    assert step <= checked.loaded.config.limits.slew_per_s
    # No faster than either of the two commands is by itself, but for the time of the fade.
    assert step <= 1.1 * checked.forecast.slew_per_s
    assert [each.code for each in recording.events] == ["inverse", "inverse", "run_ended"]
    assert replay(recording).identical


def test_bypass_replays_in_pieces(switched, monkeypatch):
    """A fade may begin in one piece and end in another, and its event may follow its samples."""
    recording, _ = switched
    monkeypatch.setattr(reader, "PIECE_SAMPLES", 3000)
    assert len(list(RecordingStream(recording.path))) > 20
    assert replay(RecordingStream(recording.path)) == replay(recording)


def test_bypass_without_its_events_is_not_replayed(switched):
    recording, _ = switched
    for events in ((), recording.events[:1], recording.events[1:]):
        with pytest.raises(DataError, match="inverse"):
            replay(replace(recording, events=events))


@pytest.mark.parametrize("learns", [
    "feedback={kind: integral, limit_um: 5.0, bandwidth_hz: 2.0}",
    "adaptation={time_constant_s: 0.3, noise_um: 0.03}",
])  # fmt: skip
def test_feedback_and_adaptation_pause_while_bypassed(learns, tmp_path, monkeypatch):
    rate_hz, cycle = 10_000, 500
    settings = [f"sample_rate_hz={rate_hz}", "block=10", "waveform.amplitude=15.0", learns]
    settings += ["waveform.frequency_hz=20", "waveform.duration_s=2.5"]
    checked = checked_experiment(DEMO, settings)
    line = checked.forecast.line
    changes = {at: Tuning(1.0, 0.0, 1000, share, line) for at, share in ((8000, 0.0), (14000, 1.0))}
    monkeypatch.setattr(_Switched, "changes", changes)
    monkeypatch.setattr(unpaced, "OfflineHost", _Switched)
    unpaced.run_unpaced(CheckedRun((checked,)), tmp_path / "run.mcap")
    recording = read(tmp_path / "run.mcap")
    samples = recording.samples
    # From the second cycle on: the first begins within a block that still learns.
    inputs = samples.input_um[8500:14000].reshape(-1, cycle)
    assert np.abs(np.diff(inputs, axis=0)).max() < 1e-9
    error_um = samples.displacement_um - samples.reference_um
    assert np.abs(error_um[9500:14000]).max() > 2.0
    assert np.abs(error_um[15500:24000].mean()) < 0.02
    assert replay(recording).identical
