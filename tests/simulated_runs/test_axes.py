"""Runs of several simulated axes: a recording per axis, as that of its own run."""

import json
from pathlib import Path

import numpy as np
import pytest
import yaml
from mcap.reader import make_reader

from hilctl import api
from hilctl.analysis.replay import replay
from hilctl.base.errors import InputError
from hilctl.base.samples import Flag
from hilctl.cli.campaigns import sweep_document
from hilctl.kernels.interlock import InterlockFlag
from hilctl.lab.studies.campaign.steps import campaign_of
from hilctl.recording.reader import read
from hilctl.recording.recover import recover_recording
from hilctl.recording.schema import TOPICS
from hilctl.run.run_folder import runs
from hilctl.run.start import checked_run, start_run
from hilctl.run.unpaced import run_unpaced
from tests.commands import hilctl

STAGE = Path(__file__).parents[2] / "configs" / "stage_xy.yaml"
SHORT = ["waveform.duration_s=0.6"]


def unpaced(path, settings, output):
    return run_unpaced(checked_run(path, settings), output)


def paced(path, settings, output):
    return start_run(path, settings, output, False, lambda progress: None)


def stage(folder, **keys):
    """Return a file with two uncompensated axes on a slow clock; ``keys`` replace some."""
    path = folder / "stage.yaml"
    experiment = {
        "name": "stage",
        "device": {"kind": "simulated_terfenol"},
        "sample_rate_hz": 1000,
        "waveform": {
            "kind": "sine", "unit": "A", "amplitude": 4.0, "frequency_hz": 5.0, "duration_s": 1.0,
        },
        "compensator": "none",
        "limits": {"peak_current_a": 5.0, "slew_a_per_s": 1000.0, "stroke_um": [-60.0, 60.0]},
        "safe": {"ramp_s": 0.2},
        "axes": {"x": {"device": {"seed": 1}}, "y": {"device": {"seed": 2}}},
        **keys,
    }  # fmt: skip
    path.write_text(yaml.safe_dump(experiment, sort_keys=False), encoding="utf-8")
    return path


def assert_same_samples(found, expected):
    """Compare all columns, bit for bit."""
    n = expected.samples.index.size
    assert found.samples.index[:n].tolist() == expected.samples.index.tolist()
    assert found.samples.flags[:n].tolist() == expected.samples.flags.tolist()
    for name, column in expected.samples.columns().items():
        assert found.samples.columns()[name][:n].tobytes() == column.tobytes(), name
    assert set(found.samples.command[n:]) <= {0.0}  # it rests until the others do


@pytest.mark.parametrize("run", [unpaced, paced])
def test_each_axis_is_recorded_as_in_a_run_of_its_own(tmp_path, run):
    result = run(STAGE, SHORT, tmp_path / "stage.mcap")
    assert (result.code, result.path) == ("completed", tmp_path / "stage.x.mcap")
    recorded = {name: read(axis.path) for name, axis in result.axes.items()}
    assert len({each.run["run_id"] for each in recorded.values()}) == 1
    for name, recording in recorded.items():
        assert recording.path == tmp_path / f"stage.{name}.mcap"
        assert (recording.run["axis"], json.loads(recording.run["axes"])) == (name, ["x", "y"])
        assert replay(recording).identical
        alone = run(STAGE, [*SHORT, f"axis={name}"], tmp_path / f"{name}.mcap")
        assert alone.axes == {}
        own = read(alone.path)
        assert not {"axis", "axes"} & own.run.keys()
        assert recording.experiment_yaml == own.experiment_yaml
        assert recording.run["experiment_sha256"] == own.run["experiment_sha256"]
        assert_same_samples(recording, own)
    x, y = recorded.values()
    assert not np.array_equal(x.samples.displacement_um, y.samples.displacement_um)
    assert runs() == []


def test_the_shorter_axis_holds_its_last_value(tmp_path):
    own = "axes.y.waveform.duration_s=0.5"
    result = unpaced(STAGE, [*SHORT, own], tmp_path / "stage.mcap")
    x, y = (read(each).samples for each in result.recordings)
    assert x.index.tolist() == y.index.tolist()
    alone = read(unpaced(STAGE, [own, "axis=y"], tmp_path / "y.mcap").path).samples
    n = round(0.5 * 50000) - 50  # before them the inverse looks ahead
    assert y.command[:n].tobytes() == alone.command[:n].tobytes()
    assert set(y.reference_um[25000:30000]) == {y.reference_um[24999]}


@pytest.mark.parametrize("run", [unpaced, paced])
def test_an_interlock_of_one_axis_ramps_both_down_from_the_same_sample(tmp_path, run):
    """The displacement of y leaves its range, of which the check knows nothing without a model."""
    limits = {"stroke_um": [-60.0, 20.0]}
    axes = {"x": {"device": {"seed": 1}}, "y": {"device": {"seed": 2}, "limits": limits}}
    result = run(stage(tmp_path, axes=axes), [], tmp_path / "run.mcap")
    assert result.code == "fault"
    assert result.reason.startswith("y: ")
    found = [read(each) for each in result.recordings]
    begun = [int(np.argmax(each.samples.flags & Flag.RAMP)) for each in found]
    assert begun[0] == begun[1] > 0
    assert len({each.end["reason"] for each in found}) == 1
    assert [{event.code for event in each.events} for each in found] == [
        {"stroke", "run_ended"}, {"stroke", "run_ended"},
    ]  # fmt: skip
    assert {each.samples.command[-1] for each in found} == {0.0}
    assert all(replay(each).identical for each in found)


@pytest.mark.parametrize("run", [unpaced, paced])
def test_a_gantry_ends_if_one_rod_moves_further(tmp_path, run):
    gantry = STAGE.with_name("gantry.yaml")
    assert run(gantry, SHORT, tmp_path / "equal.mcap").code == "completed"
    other = [*SHORT, "axes.right.device.vary.strain=1.2"]
    result = run(gantry, other, tmp_path / "other.mcap")
    assert (result.code, result.reason[:7]) == ("fault", "right: ")
    left, right = (read(each) for each in result.recordings)
    for each in (left, right):
        assert {event.code for event in each.events} == {"apart", "run_ended"}
        assert each.end["reason"] == result.reason
        assert replay(each).identical
    tripped = [np.flatnonzero(each.samples.flags & InterlockFlag.APART) for each in (left, right)]
    assert tripped[0].tolist() == tripped[1].tolist()
    um = np.abs(left.samples.displacement_um - right.samples.displacement_um)
    first = tripped[0][0]
    assert (um[first - 50 : first + 1] > 5.0).all()  # for longer than 1 ms
    assert um[first - 51] <= 5.0


def test_conditioning_of_one_axis_is_waited_for_by_the_other(tmp_path):
    """Both begin their waveform with the same sample."""
    axes = {
        "x": {"device": {"seed": 1}},
        "y": {"device": {"seed": 2}, "condition": {"cycles": 4, "rest_s": 0.2}},
    }
    path = stage(tmp_path, axes=axes)
    result = unpaced(path, [], tmp_path / "run.mcap")
    x, y = (read(each) for each in result.recordings)
    assert x.segments[0].start == y.segments[0].start > 0
    assert set(x.samples.command[: x.segments[0].start]) == {0.0}
    assert replay(x).identical
    assert replay(y).identical
    alone = read(unpaced(path, ["axis=y"], tmp_path / "y.mcap").path)
    assert_same_samples(y, alone)


def test_recordings_of_a_run_have_topics_of_their_own(tmp_path):
    experiment = stage(tmp_path, recording={"flush_s": 0.3})
    result = unpaced(experiment, [], tmp_path / "run.mcap")
    for name, axis in result.axes.items():
        whole = read(axis.path)
        axis.path.write_bytes(axis.path.read_bytes()[: axis.path.stat().st_size // 2])
        for path in (recover_recording(axis.path).original, axis.path):
            found = read(path).samples
            assert 0 < found.index.size < whole.samples.index.size
            assert np.array_equal(found.command, whole.samples.command[: found.index.size])
        with axis.path.open("rb") as stream:
            channels = make_reader(stream).get_summary().channels.values()
        assert {each.topic for each in channels} == {f"/{name}{topic}" for topic in TOPICS}


def test_a_refused_axis_leaves_no_file(tmp_path):
    (tmp_path / "run.y.mcap").write_text("mine")
    with pytest.raises(InputError, match=r"run\.y\.mcap"):
        unpaced(stage(tmp_path), [], tmp_path / "run.mcap")
    assert {each.name for each in tmp_path.iterdir()} == {"stage.yaml", "run.y.mcap"}


def test_the_command_prints_a_line_per_axis(tmp_path):
    words = ["run", str(stage(tmp_path)), "--output", str(tmp_path / "run.mcap")]
    lines = hilctl(*words).stdout.splitlines()
    assert [line.split()[0] for line in lines[1:3]] == ["x", "y"]
    assert [line for line in lines if line.startswith("recorded: ")] == [
        f"recorded: {tmp_path / name}" for name in ("run.x.mcap", "run.y.mcap")
    ]
    found = json.loads(hilctl(*words, "--overwrite", "--json").stdout)
    assert list(found["axes"]) == ["x", "y"]
    assert found["axes"]["y"]["output"] == str(tmp_path / "run.y.mcap")
    assert found["axes"]["y"]["samples"] == 1000
    assert found["output"] == str(tmp_path / "run.x.mcap")


def test_a_campaign_has_a_row_per_axis_with_the_contour_error(tmp_path):
    steps = campaign_of(sweep_document(STAGE, ["waveform.amplitude=20,30"], 1), Path(), SHORT)
    result = api.campaign(steps, tmp_path, fast=True)
    assert [row.axis for _, row in result.ordered] == ["x", "y"] * 2
    for _, row in result.ordered:
        report = api.contour([tmp_path / row.recording])
        assert row.contour_um == report.peak_um
        assert row.figures.peak_error_percent == report.axes[row.axis].peak_error_percent


@pytest.mark.long
def test_three_axes_at_50_khz_drop_no_sample(tmp_path):
    axes = {name: {"device": {"seed": k}} for k, name in enumerate("xyz")}
    settings = [f"axes={json.dumps(axes)}", "waveform.duration_s=5", "block=500"]
    result = paced(STAGE, settings, tmp_path / "run.mcap")
    assert result.code == "completed"
    assert [each.missing for each in result.axes.values()] == [0, 0, 0]
    for path in result.recordings:
        recording = read(path)
        assert recording.samples.index.size >= 250_000
        assert recording.dropped == 0
        assert replay(recording).identical
