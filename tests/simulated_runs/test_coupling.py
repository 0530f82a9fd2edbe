"""Crosstalk on simulated stages: identified, removed before the run, and what is left of it."""

import json

import numpy as np
import pytest

from hilctl import api
from hilctl.analysis.replay import replay
from hilctl.base.errors import InputError
from hilctl.experiment.sections.coupling import load_coupling
from hilctl.recording.reader import read
from tests.commands import hilctl
from tests.simulated_runs.test_axes import STAGE

RATE_HZ = 50e3
MIDDLE_UM, RADIUS_UM = -6.9, 30.0


def crosstalk(x=None, y=None, **more):
    """Return the settings of the crosstalk into each axis."""
    found = {"axes.x.device.crosstalk": {"y": x} if x else {}}
    return found | {"axes.y.device.crosstalk": {"x": y} if y else {}} | more


def mode(gain, natural_hz):
    return {"gain": gain, "natural_hz": natural_hz, "damping_ratio": 0.05}


RIGS = {
    "a mode at 180 Hz": crosstalk(mode(0.04, 180.0), mode(0.04, 180.0)),
    "others": crosstalk(
        mode(0.03, 220.0), {"gain": 0.045}, **{"axes.x.device.seed": 7, "axes.y.device.seed": 8}
    ),
}


@pytest.fixture(scope="module")
def coupled(tmp_path_factory):
    """Return a function from the name of a rig to its settings without and with coupling."""
    known = {}

    def of(rig):
        if rig not in known:
            file = tmp_path_factory.mktemp("coupled") / "coupling.yaml"
            api.couple(STAGE, file, settings=RIGS[rig], fast=True)
            known[rig] = RIGS[rig], RIGS[rig] | {"coupling": str(file)}
        return known[rig]

    return of


def run(folder, settings):
    """Return the recordings of a completed run by axis; each one replays alone."""
    result = api.run(STAGE, folder / "run.mcap", settings=settings, fast=True, overwrite=True)
    assert result.code == "completed"
    found = {axis: read(each.path) for axis, each in result.axes.items()}
    assert all(replay(each).identical for each in found.values())
    return found


def mean_cycle(recording, frequency_hz):
    """Return reference and displacement on even phases: float64[2, 1000], mean of all cycles."""
    segment, samples = recording.segments[-1], recording.samples
    period = RATE_HZ / frequency_hz
    since = samples.index - segment.steady_start
    cycles = (segment.steady_stop - segment.steady_start) // period
    steady = (since >= period) & (since < cycles * period)
    phase = (np.mod(since[steady], period) / period * 1000.0).astype(np.int64)
    count = np.bincount(phase, minlength=1000)
    return np.array([
        np.bincount(phase, values[steady], 1000) / count
        for values in (samples.reference_um, samples.displacement_um)
    ])  # fmt: skip


def contour_percent(folder, frequency_hz, settings):
    """Return the largest contour error of the mean circle, in percent of its diameter."""
    duration_s = round(0.4 + 40.0 / frequency_hz, 5)
    circle = {"waveform.frequency_hz": frequency_hz, "waveform.duration_s": duration_s}
    found = run(folder, settings | circle)
    cycles = np.array([mean_cycle(each, frequency_hz) for each in found.values()])
    radii = np.hypot(*(cycles - MIDDLE_UM))
    return 100.0 * np.abs(radii[1] - radii[0]).max() / (2.0 * RADIUS_UM)


@pytest.mark.parametrize("frequency_hz", [20.0, 60.0, 120.0])
@pytest.mark.parametrize("rig", RIGS)
def test_circle_is_one_again(tmp_path, coupled, rig, frequency_hz):
    plain, decoupled = coupled(rig)
    assert contour_percent(tmp_path, frequency_hz, plain) >= 2.0
    assert contour_percent(tmp_path, frequency_hz, decoupled) <= 0.6


@pytest.mark.parametrize("frequency_hz", [pytest.param(20.0, marks=pytest.mark.long), 120.0])
@pytest.mark.parametrize("used", [False, True])
def test_circle_is_learned_to_the_noise(tmp_path, coupled, frequency_hz, used):
    """With a coupling or without; the corrections of one are refused by the other."""
    plain, decoupled = coupled("a mode at 180 Hz")
    settings, other = (decoupled, plain) if used else (plain, decoupled)
    duration_s = round(0.4 + 20.0 / frequency_hz, 5)
    circle = {"waveform.frequency_hz": frequency_hz, "waveform.duration_s": duration_s}
    api.learn(STAGE, tmp_path / "circle.yaml", settings=settings | circle, fast=True)
    files = {
        f"axes.{axis}.compensator.correction": str(tmp_path / f"circle.{axis}.yaml")
        for axis in "xy"
    }
    assert contour_percent(tmp_path, frequency_hz, settings | files) <= 0.15
    with pytest.raises(InputError, match="coupling"):
        api.check_axes(STAGE, settings=other | files | circle)


def moved(folder, frequency_hz, moving, settings):
    """Return the sine of each axis when one moves and the other holds: complex amplitudes."""
    duration_s = round(0.4 + 40.0 / frequency_hz, 5)
    common = {"unit": "um", "offset": MIDDLE_UM, "duration_s": duration_s, "soft_start_s": 0.4}
    sine = {"kind": "sine", "amplitude": RADIUS_UM, "frequency_hz": frequency_hz, "phase_deg": 0.0}
    waveforms = {
        f"axes.{axis}.waveform": {"soft_end_s": 0.0} | common | (
            sine if axis == moving else {"kind": "hold", "level": 0.0}
        )
        for axis in "xy"
    }  # fmt: skip
    found = {}
    recordings = run(folder, settings | waveforms)
    start = recordings[moving].segments[-1].steady_start + round(10.0 * RATE_HZ / frequency_hz)
    stop = start + round(25.0 * RATE_HZ / frequency_hz)
    for axis, recording in recordings.items():
        samples = recording.samples.part(start, stop)
        turns = samples.index * (frequency_hz / RATE_HZ)
        found[axis] = 2.0 * np.mean(samples.displacement_um * np.exp(-2j * np.pi * turns))
    return found


def test_beam_of_two_modes_leaves_what_was_said(tmp_path, other_rigs):
    """The coupling has no stiffness matrix, nor does the beam leave the moving axis alone."""
    settings = {"device.kind": "simulated_framed"}
    coupling = api.couple(STAGE, tmp_path / "coupling.yaml", settings=settings, fast=True)
    decoupled = settings | {"coupling": str(tmp_path / "coupling.yaml")}
    for sensor, moving in ("xy", "yx"):
        known = coupling.into[sensor][moving]
        for frequency_hz in (20.0, 60.0):
            before, after = (
                abs(moved(tmp_path, frequency_hz, moving, each)[sensor])
                for each in (settings, decoupled)
            )
            assert before > 0.02 * RADIUS_UM
            assert after <= 0.15 * before
            said = np.interp(np.log(frequency_hz), np.log(known.left_hz), known.left_percent)
            assert said == pytest.approx(100.0 * after / before, rel=0.25)


def test_command_resumes_and_prints_the_crosstalk(tmp_path):
    file = tmp_path / "coupling.yaml"
    seen = crosstalk(y={"gain": 0.05})
    words = [f"--set={key}={json.dumps(value)}" for key, value in seen.items()]
    words += ["--set=sample_rate_hz=20000", "--set=block=20", "--highest-hz=400", "--fast"]
    command = ("couple", STAGE, "--output", file, *words)
    found = json.loads(hilctl(*command, "--json").stdout)
    (tap,) = found["into"]["y"]["x"]["taps"]
    assert (tap, found["into"]["x"]) == (pytest.approx(0.05, rel=0.03), {})
    assert load_coupling(file).into["y"]["x"].taps == (tap,)
    recordings = sorted(file.with_name("coupling-runs").glob("*.mcap"))
    times = [each.stat().st_mtime_ns for each in recordings]
    assert len(recordings) == 8
    file.unlink()
    assert "good" in hilctl(*command).stdout
    assert [each.stat().st_mtime_ns for each in recordings] == times
