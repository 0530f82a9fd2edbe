"""A window of a reference: filled ahead of the loop, and never over what it still needs."""

import os
import signal
import time
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from hilctl.base import values
from hilctl.base.errors import RunError
from hilctl.loop import window
from hilctl.recording.reader import read
from hilctl.run import reference_window
from hilctl.run.host import SharedWindow
from hilctl.run.job import Job
from hilctl.run.reference_window import OwnWindow, ReferenceProcess, WindowFiller
from hilctl.run.ring import SampleRing
from hilctl.run.shared_page import Field
from hilctl.run.start import checked_experiment
from hilctl.run.unpaced import run_unpaced

CONFIGS = Path(__file__).parents[3] / "configs"
SHORT = ["waveform.duration_s=0.5", "waveform.frequency_hz=100"]


@pytest.fixture
def small(monkeypatch):
    """Let nothing fit in memory, and a window hold 7 blocks of 50."""
    monkeypatch.setattr(values, "IN_MEMORY", 300)
    monkeypatch.setattr(window, "_LEAST_SAMPLES", 350)
    monkeypatch.setattr(window, "_LEAST_S", 0.0)
    monkeypatch.setattr(reference_window, "_PIECE", 64)


@pytest.mark.parametrize("piece", [1, 7, 64, 1000])
@pytest.mark.parametrize("same", [True, False])
def test_each_sample_is_there_when_it_is_needed(monkeypatch, piece, same):
    """At its place, from the moment that it is said to be there until it is used."""
    monkeypatch.setattr(reference_window, "_PIECE", piece)
    reference, input_um = np.arange(1003.0), np.arange(1003.0) + (0.0 if same else 0.5)
    window = np.full(40, np.nan)
    arrays = window, window if same else np.full(40, np.nan)
    filler = WindowFiller(reference, reference if same else input_um, arrays)
    own = OwnWindow(filler, 10)
    for start in range(0, 1003, 10):
        stop = min(start + 10, 1003)
        assert own.has(stop)
        places = np.arange(start, min(filler.ready, 1003)) % 40
        assert arrays[0][places].tolist() == reference[start : filler.ready].tolist()
        assert arrays[1][places].tolist() == input_um[start : filler.ready].tolist()
    assert own.samples == 1003
    assert not own.has(1004)


def test_nothing_is_filled_over_what_is_not_used():
    filler = WindowFiller(np.arange(100.0), np.arange(100.0), (np.empty(20), np.empty(20)))
    while filler.fill(0):
        pass
    assert filler.ready == 20
    assert filler.fill(3)
    assert filler.ready == 23
    assert not filler.fill(3)


@pytest.mark.parametrize("model", ["omega", "staged"])
@pytest.mark.parametrize(
    "more",
    [
        [],
        ["adaptation={noise_um: 0.05, time_constant_s: 0.3}", "waveform.amplitude=20"],
        ["condition={}"],
        ["feedback={kind: integral, bandwidth_hz: 1.0, limit_um: 5.0}"],
        ["block=40", "waveform.soft_end_s=0.0"],
    ],
    ids=lambda more: more[0].partition("=")[0] if more else "plain",
)
def test_a_run_by_a_window_is_the_run_by_all_of_it(tmp_path, request, model, more):
    """Bit for bit, whatever stands between reference and command."""
    settings = [*SHORT, *more, f"compensator.model=models/terfenol_{model}.yaml"]
    experiment = CONFIGS / "terfenol_sine_6a.yaml"
    whole = read(run_unpaced(checked_experiment(experiment, settings), tmp_path / "a.mcap").path)
    request.getfixturevalue("small")
    checked = checked_experiment(experiment, settings)
    assert not values.in_memory(checked.reference.values)
    result = run_unpaced(checked, tmp_path / "b.mcap")
    found = read(result.path)
    assert result.code == "completed"
    for name, column in whole.samples.columns().items():
        assert getattr(found.samples, name).tobytes() == column.tobytes(), name
    assert found.samples.flags.tolist() == whole.samples.flags.tolist()


def test_the_loop_looks_how_far_it_is_filled(tmp_path):
    """And not again for what it knows to be there."""
    page = SampleRing.create(tmp_path / "ring", slots=4, block=1, state_size=1).page
    shared = SharedWindow(page, 1000)
    page.put(Field.REFERENCE_READY, 300)
    assert shared.has(300)
    assert not shared.has(301)
    page.put(Field.REFERENCE_READY, 0)
    assert shared.has(300)


@pytest.fixture
def begun(tmp_path, small):
    """A long run's experiment, its ring, and the files that its loop gets."""
    checked = checked_experiment(CONFIGS / "terfenol_sine_6a.yaml", SHORT)
    ring = SampleRing.create(tmp_path / "ring", slots=4, block=50, state_size=1)
    folder = SimpleNamespace(
        ring=tmp_path / "ring",
        reference=tmp_path / "reference.npy",
        input_um=tmp_path / "input.npy",
        description=tmp_path / "description.json",
    )
    job = Job.of(checked, folder, supervisor=os.getpid(), silence_s=1.0)
    return SimpleNamespace(checked=checked, page=ring.page, folder=folder, job=job)


def await_ready(page, samples):
    until = time.monotonic() + 20.0
    while page.get(Field.REFERENCE_READY) < samples:
        assert time.monotonic() < until
        time.sleep(0.002)


def test_a_process_fills_it_ahead_of_the_loop(begun):
    """From what the job left there, by what the loop says that it has used."""
    reference = begun.checked.reference.values
    window = begun.job.arrays()[0]
    assert (window.size, begun.job.samples) == (350, 25_000)
    assert window.tolist() == reference[0:350].tolist()
    with ReferenceProcess(begun.checked) as process:
        process.begin(begun.folder, begun.page)
        assert begun.page.get(Field.REFERENCE_READY) == 350
        for used in (50, 100, 450, 24_999):
            begun.page.put(Field.NEXT_SAMPLE, used)
            ready = min(used + 350, 25_000)
            await_ready(begun.page, ready)
            assert begun.page.get(Field.REFERENCE_READY) == ready
            places = np.arange(used, ready) % 350
            assert window[places].tolist() == reference[used:ready].tolist()
        process._process.join(20)
        assert process._process.exitcode == 0


def test_its_input_is_another_array_where_that_is_another(begun, tmp_path):
    model = "compensator.model=models/terfenol_staged.yaml"
    checked = checked_experiment(CONFIGS / "terfenol_sine_6a.yaml", [*SHORT, model])
    job = Job.of(checked, begun.folder, supervisor=os.getpid(), silence_s=1.0)
    with ReferenceProcess(checked) as process:
        process.begin(begun.folder, begun.page)
        begun.page.put(Field.NEXT_SAMPLE, 200)
        await_ready(begun.page, 550)
        reference, input_um = job.arrays()
        places = np.arange(200, 550) % 350
        assert reference[places].tolist() == checked.reference.values[200:550].tolist()
        assert input_um[places].tolist() == checked.begun.input_um[200:550].tolist()


def test_signals_to_all_are_the_supervisors(begun):
    with ReferenceProcess(begun.checked) as process:
        number = process._process.pid
        for sent in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGUSR1):
            os.kill(number, sent)
        process.begin(begun.folder, begun.page)
        begun.page.put(Field.NEXT_SAMPLE, 100)
        await_ready(begun.page, 450)
    with pytest.raises(ProcessLookupError):
        os.kill(number, 0)


def test_without_its_supervisor_it_ends(begun):
    with ReferenceProcess(begun.checked) as process:
        process._connection.close()
        process._process.join(20)
        assert process._process.exitcode == 0
        with pytest.raises(RunError, match="the process that works the reference out is gone"):
            process.begin(begun.folder, begun.page)


def test_what_fits_in_memory_needs_no_process(begun, monkeypatch):
    monkeypatch.setattr(values, "IN_MEMORY", 10**6)
    checked = checked_experiment(CONFIGS / "terfenol_sine_6a.yaml", SHORT)
    with ReferenceProcess(checked) as process:
        process.begin(begun.folder, begun.page)
    assert begun.page.get(Field.REFERENCE_READY) == 0
    with ReferenceProcess(replace(begun.checked)) as process:
        assert process._process.is_alive()
