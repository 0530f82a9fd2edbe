"""Replay: the recorded reference, through the code that ran, gives the recorded bits again."""

import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml

from hilctl.analysis.replay import replay
from hilctl.analysis.report import summarize
from hilctl.base.errors import DataError
from hilctl.base.events import OFFSET
from hilctl.base.samples import Flag
from hilctl.experiment.device_state import initial_state_after
from hilctl.experiment.preflight import CheckedRun
from hilctl.loop.compensator import Compensator
from hilctl.models.base import HysteresisModel
from hilctl.models.linear_stages import FirstMode
from hilctl.models.model_file import dump_model
from hilctl.models.staged import FieldLag, StagedModel
from hilctl.recording.reader import read
from hilctl.recording.recording import Recording
from hilctl.run.result import RunResult
from hilctl.run.start import checked_experiment, checked_run, start_run
from hilctl.run.unpaced import run_unpaced
from tests.published import terfenol_rdpi

SINE = Path(__file__).parents[2] / "configs" / "terfenol_sine_6a.yaml"
GOLDEN = sorted((Path(__file__).parents[2] / "recordings" / "golden").glob("*.mcap"))


STAGED = StagedModel.around(
    terfenol_rdpi(),
    lag=FieldLag(tau_s=1e-4, growth_per_unit=0.3),
    structure=FirstMode(natural_hz=2200.0, damping_ratio=0.12),
    delay_s=3e-5,
)


def unpaced(path: Path, output: Path) -> RunResult:
    """Run in this process, as fast as it goes."""
    return run_unpaced(checked_run(path, []), output)


def paced(path: Path, output: Path) -> RunResult:
    """Run as ``hilctl run`` does, in processes of its own."""
    return start_run(path, [], output, False, lambda progress: None)


def record(
    folder: Path,
    model: HysteresisModel,
    duration_s: float,
    after: Path | None = None,
    run: Callable[[Path, Path], RunResult] = unpaced,
) -> Recording:
    """Run a compensated sine to its end, perhaps after another run."""
    (folder / "model.yaml").write_text(dump_model(model))
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
            "duration_s": duration_s,
            "soft_start_s": 0.05,
        },
        "compensator": {"model": "model.yaml"} | ({"initial_state": str(after)} if after else {}),
        "limits": {"peak_current_a": 4.0, "slew_a_per_s": 4000.0, "stroke_um": [-40.0, 40.0]},
    }
    path = folder / "experiment.yaml"
    path.write_text(yaml.safe_dump(experiment))
    result = run(path, folder / "run.mcap")
    assert result.code == "completed"
    return read(result.path)


@pytest.fixture(scope="module")
def recording(tmp_path_factory) -> Recording:
    """A short compensated run that is stopped by its end, limits untouched."""
    return record(tmp_path_factory.mktemp("replay"), terfenol_rdpi(), 0.4, run=paced)


@pytest.fixture(scope="module")
def ahead(tmp_path_factory) -> Recording:
    """A run whose compensator looks ahead."""
    return record(tmp_path_factory.mktemp("ahead"), STAGED, 0.2)


@pytest.mark.slow
def test_own_recording_is_identical(recording):
    """Every wanted command, command and flag comes out bit for bit, the ramp included."""
    result = replay(recording)
    assert result.identical
    assert result.samples == recording.samples.index.size > 8000
    assert result.first_difference is None


def test_run_that_looks_ahead_is_identical(ahead):
    """What was fed is recorded, the reference ahead of its time, and gives the bits again.

    At its end the period of 500 samples continues.
    """
    preview = STAGED.inverse(ahead.sample_rate_hz).preview
    samples = ahead.samples
    assert preview == 8
    continued = [*samples.reference_um[preview:4000], *samples.reference_um[3500 : 3500 + preview]]
    assert samples.input_um[:4000].tolist() == continued
    assert np.isnan(samples.input_um[4000:]).all()
    assert replay(ahead).identical


def test_another_model_is_fed_by_its_own_preview(ahead, recording):
    """A recording replayed with another model is fed as far ahead as that one looks."""
    assert np.array_equal(
        recording.samples.input_um, recording.samples.reference_um, equal_nan=True
    )
    samples = replace(ahead.samples, input_um=np.zeros_like(ahead.samples.input_um))
    assert replay(replace(ahead, samples=samples), STAGED).identical
    plain = replay(ahead, terfenol_rdpi())
    command = terfenol_rdpi().inverse(20e3).process(ahead.samples.reference_um[:4000].copy())
    assert plain.command_max == pytest.approx(command.max(), abs=1e-12)


def test_run_that_goes_on_after_another_is_identical(ahead, tmp_path):
    """Begun with what a run before left, a run records that memory, and replays from it."""
    memory = initial_state_after(ahead.path, STAGED, ahead.sample_rate_hz, time.time(), 0.0)
    after = record(tmp_path, STAGED, 0.1, ahead.path)
    begun = Compensator(STAGED, ahead.sample_rate_hz)
    begun.restore(memory.state)
    begun.begin(memory.lead_in(after.samples.reference_um[:8], 4000))
    np.testing.assert_allclose(after.starts[0].state, begun.state(), atol=1e-12)
    assert after.samples.input_um[0] == pytest.approx(memory.stands_um, rel=1e-3)
    assert after.run["initial_state_run_id"] == ahead.run["run_id"] != ""
    assert ahead.run["initial_state_run_id"] == ""
    assert replay(after).identical


@pytest.mark.slow
@pytest.mark.parametrize("block", [1, 50])
@pytest.mark.parametrize("output", [0.0, 2.0])
def test_run_with_a_condition_is_identical(tmp_path, block, output):
    """Ramp, conditioning, measured offset, integrator; no figure has it."""
    settings = [
        f"block={block}",
        "sample_rate_hz=5000",
        f"device.output_at_open={output}",
        "device.drift={um: 4.0, tau_s: 0.01}",
        "condition={cycles: 4, rest_s: 0.2}",
        "feedback={kind: integral, limit_um: 5.0, bandwidth_hz: 2.0}",
        "waveform.duration_s=0.5",
        "waveform.offset=0.0",
        "waveform.amplitude=20.0",
        "compensator={model: models/terfenol_staged.yaml, offset: measured}",
    ]
    checked = checked_experiment(SINE, settings)
    recording = read(run_unpaced(CheckedRun((checked,)), tmp_path / "run.mcap").path)
    result = replay(recording)
    assert (result.identical, result.left_out_samples) == (True, 0)
    samples, conditioning = recording.samples, checked.conditioning()
    conditioned = (samples.flags & Flag.CONDITION) != 0
    assert samples.wanted[conditioned].tolist() == conditioning.command.tolist()
    assert recording.segments[0].start == int(samples.index[conditioned][-1]) + 1
    (event,) = (each for each in recording.events if each.code == OFFSET)
    assert event.values["offset_um"] == pytest.approx(4.0, abs=1.0)
    report = summarize(recording)
    assert report.samples == checked.forecast.samples
    assert report.segments[0].steady_cycles == 1


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
    gapped = replace(
        recording,
        samples=samples.rows((samples.index < 1600) | (samples.index >= cut)),
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
    with pytest.raises(DataError, match="no samples"):
        replay(empty)
    with pytest.raises(DataError, match="compensator"):
        replay(replace(recording, compensated=False), terfenol_rdpi())


@pytest.mark.parametrize("path", GOLDEN, ids=lambda path: path.stem)
def test_golden_recordings_replay_bit_for_bit(path):
    """Recordings made by earlier versions still give the same bits."""
    result = replay(read(path))
    assert result.identical, result
    assert result.samples > 1000


@pytest.mark.parametrize("name", ["refined_0_2_0", "staged_0_2_0"])
def test_inverses_of_0_2_0_replay_bit_for_bit(name):
    """Nothing writes residual operators any more, and that of a structure has changed."""
    result = replay(read(Path(__file__).parents[1] / "data" / f"{name}.mcap"))
    assert result.identical, result
    assert result.samples > 1000


def test_golden_recordings_are_there():
    """A compensated, an uncompensated and a voltage-driven run."""
    names = {path.stem for path in GOLDEN}
    assert names >= {"terfenol_compensated", "terfenol_uncompensated", "piezo_compensated"}
