"""Invalid input on the command line: one message, exit code 2, no files left."""

import json
import os
import subprocess
import sys

import pytest

from tests.commands import Ended, in_process

GOOD = """\
name: tiny
device: {kind: simulated_terfenol}
sample_rate_hz: 1000
block: 10
waveform: {kind: sine, unit: A, amplitude: 1.0, frequency_hz: 5.0, duration_s: 0.2}
compensator: none
limits: {peak_current_a: 2.0, slew_a_per_s: 500.0, stroke_um: [-75.0, 60.0]}
"""
MODEL = """\
model:
  kind: rdpi
  direct: 2.7
  weights: [2.3, 0.4]
  thresholds: [0.3, 0.6]
  output_range_um: [-12.0, 12.0]
"""
IN_UM = GOOD.replace("unit: A", "unit: um").replace(
    "compensator: none", "compensator: {model: model.yaml}"
)


def contents(folder):
    return {
        path: path.read_bytes() if path.is_file() else None for path in sorted(folder.rglob("*"))
    }


@pytest.fixture
def place(tmp_path, monkeypatch):
    """A working folder, and an empty folder for files in shared memory."""
    memory, folder = tmp_path / "memory", tmp_path / "place"
    memory.mkdir()
    folder.mkdir()
    monkeypatch.setenv("HILCTL_RUNS", str(memory))
    monkeypatch.chdir(folder)
    yield folder
    assert list(memory.iterdir()) == []


@pytest.fixture
def hilctl(monkeypatch, capsys):
    return in_process(monkeypatch, capsys)


def check_refused(ended, message):
    assert ended.code == 2
    assert "Traceback" not in ended.out + ended.err
    lines = ended.err.splitlines()
    assert lines
    assert all(line.startswith("hilctl: ") for line in lines)
    assert message in ended.err
    assert len(lines) == len(set(lines))
    if ended.out:
        assert message in json.loads(ended.out)["error"]


@pytest.fixture
def refused(hilctl, place):
    """Return a function that runs a command as it is and with ``--json``; no file may change."""

    def check(message, *words):
        before = contents(place)
        for as_json in (False, True):
            ended = hilctl(*words, *["--json"] * as_json)
            check_refused(ended, message)
            assert bool(ended.out) == as_json
            assert contents(place) == before

    return check


@pytest.fixture
def refused_everywhere(refused):
    """Return a function that runs check and run."""

    def check(message, *words):
        for command in ("check", "run"):
            refused(message, command, *words)

    return check


SINE = "{kind: sine, unit: A, amplitude: 1.0, frequency_hz: 5.0, duration_s: 0.2}"
BROKEN = [
    ("malformed", GOOD, "60.0]}", "60.0}", "7: is not readable YAML"),
    ("empty", GOOD, GOOD, "", "1: must hold a mapping of keys to values"),
    ("unknown key", GOOD, "limits:", "limit: {}\nlimits:",
     "7: limit: unknown key (did you mean 'limits'?)"),
    ("wrong type", GOOD, "block: 10", "block: [10]",
     "4: block: must be a whole number, got [10]"),
    ("number that YAML reads as text", GOOD, "sample_rate_hz: 1000", "sample_rate_hz: 1_000",
     "3: sample_rate_hz: must be a number, got '1_000' (write a plain number, such as "
     "1000, 0.5 or 1e-3)"),
    ("not a number", GOOD, "amplitude: 1.0", "amplitude: .nan",
     "5: waveform.amplitude: must be a finite number, got nan"),
    ("command beyond the limits", GOOD, "amplitude: 1.0", "amplitude: 3.0",
     "7: limits.peak_current_a: the run must stay within -2 to 2 A, got -3 to 3 A (1 A too much"),
    ("frequency above half the rate", GOOD, "frequency_hz: 5.0", "frequency_hz: 500.0",
     "5: waveform: sine: every frequency must be below half the sample rate, 500 Hz: 500 Hz"),
    ("reference beyond the model", IN_UM, "amplitude: 1.0", "amplitude: 12.5",
     "5: waveform: reference must stay within the range that compensator.model was "
     "identified on, -12 to 12 µm, got -12.5 to 12.5 µm ("),
    ("unknown device", GOOD, "simulated_terfenol", "simulated_terfenal",
     "2: device.kind: unknown device 'simulated_terfenal' (did you mean 'simulated_terfenol'?)"),
    ("missing model", IN_UM, "model.yaml", "lost.yaml",
     "6: compensator.model: lost.yaml: no such file"),
    ("missing waveform file", GOOD, SINE, "{kind: file, unit: A, path: lost.csv}",
     "5: waveform: lost.csv: no such file"),
]  # fmt: skip


@pytest.mark.parametrize(
    ("text", "old", "new", "message"),
    [case[1:] for case in BROKEN],
    ids=[each[0] for each in BROKEN],
)
def test_experiment(refused_everywhere, place, text, old, new, message):
    (place / "x.yaml").write_text(text.replace(old, new))
    (place / "model.yaml").write_text(MODEL)
    refused_everywhere(f"x.yaml:{message}", "x.yaml")


@pytest.mark.parametrize(("old", "new", "message"), [
    ("[2.3, 0.4]", "[2.3, -0.4]", "a_2 must be >= 0 for the inverse to exist: -0.4"),
    ("direct: 2.7", "direct: 0", "a_0 must be > 0 for the inverse"),
    ("[0.3, 0.6]", "[0.6, 0.3]", "r must rise from 0"),
])  # fmt: skip
def test_model_that_can_not_be_inverted(refused_everywhere, place, old, new, message):
    (place / "x.yaml").write_text(IN_UM)
    (place / "model.yaml").write_text(MODEL.replace(old, new))
    refused_everywhere(f"model.yaml:1: model: {message}", "x.yaml")


def test_missing_experiment_or_folder(refused_everywhere, place):
    refused_everywhere("lost.yaml: no such file", "lost.yaml")
    refused_everywhere("is not a file", place)


def test_binary_experiment(refused_everywhere, place):
    (place / "x.yaml").write_bytes(bytes(range(256)))
    refused_everywhere("x.yaml: is not UTF-8 text", "x.yaml")


@pytest.mark.parametrize(("setting", "message"), [
    ("block=x", "block: must be a whole number, got 'x'"),
    ("blok=1", "blok: unknown key (did you mean 'block'?)"),
    ("block", "must be dotted.key=value"),
    ("block=[", "block: is not readable YAML, got '['"),
])  # fmt: skip
def test_setting(refused_everywhere, place, setting, message):
    (place / "x.yaml").write_text(GOOD)
    refused_everywhere(f"setting {setting}: {message}", "x.yaml", "--set", setting)


def test_every_problem_is_told(hilctl, place):
    bad = GOOD.replace("block: 10", "block: 0.5").replace("unit: A", "unit: mA")
    (place / "x.yaml").write_text(bad)
    before = contents(place)
    ended = hilctl("run", "x.yaml", "--json")
    check_refused(ended, "x.yaml:4: block: must be a whole number, got 0.5")
    expected = [
        "x.yaml:4: block: must be a whole number, got 0.5",
        "x.yaml:5: waveform.unit: must be one of 'um', 'A' or 'V', got 'mA'",
    ]
    assert ended.err.splitlines() == [f"hilctl: {each}" for each in expected]
    assert json.loads(ended.out) == {"error": "\n".join(expected), "problems": expected}
    assert contents(place) == before


@pytest.fixture
def outputs(place):
    """A valid experiment, a file, a folder and an older recording."""
    (place / "x.yaml").write_text(GOOD)
    (place / "regular").write_text("kept")
    (place / "runs").mkdir()
    (place / "run.mcap").write_bytes(b"an older run")


@pytest.mark.usefixtures("outputs")
@pytest.mark.parametrize("overwrite", [(), ("--overwrite",)])
@pytest.mark.parametrize(("output", "message"), [
    ("lost/run.mcap", "lost/run.mcap: cannot be written: No such file or directory"),
    ("regular/run.mcap", "regular/run.mcap: cannot be written: Not a directory"),
    ("x" * 300 + ".mcap", "cannot be written: File name too long"),
    ("runs", "runs: "),
])  # fmt: skip
def test_unwritable_recording(refused, output, message, overwrite):
    refused(message, "run", "x.yaml", "--output", output, *overwrite)


@pytest.mark.usefixtures("outputs")
@pytest.mark.parametrize("name", ["/dev/null", "/dev/full", "/proc/x.mcap", "fifo", ".", "no/x"])
def test_output_that_is_no_file(refused, place, name):
    os.mkfifo(place / "fifo")
    refused(name, "run", "x.yaml", "--output", name, "--overwrite")


@pytest.mark.usefixtures("outputs")
@pytest.mark.parametrize(("words", "message"), [
    ((), "run.mcap: exists already: choose another output, or overwrite"),
    (("--overwrite", "--set", "block=0"), "setting block=0: block: must be >= 1, got 0"),
])  # fmt: skip
def test_existing_recording_is_kept(refused, words, message):
    refused(message, "run", "x.yaml", "--output", "run.mcap", *words)


@pytest.mark.usefixtures("outputs")
def test_folder_for_recordings(refused):
    setting = "recording.folder=regular/runs"
    refused("cannot create regular/runs", "run", "x.yaml", "--set", setting)


@pytest.mark.usefixtures("outputs")
@pytest.mark.parametrize("words", [
    "report {} run.mcap", "figures {} --output f", "schema --output {}",
    "run x.yaml --set compensator.model={}",
    "sweep x.yaml --vary waveform.amplitude=0.5,1 --fast --folder {}",
])  # fmt: skip
def test_path_that_the_system_refuses(refused, words):
    refused("File name too long", *words.format("x" * 300).split())


@pytest.mark.usefixtures("outputs")
def test_output_without_a_name(refused):
    refused(".: is a folder", "learn", "x.yaml", "--fast", "--output", "")


@pytest.mark.parametrize("words", ["report {}", "replay {}", "export {} out.csv"])
def test_recording_to_read(refused, place, words):
    (place / "folder.mcap").mkdir()
    (place / "text.mcap").write_text("no recording")
    os.mkfifo(place / "pipe.mcap")
    folder = "cannot be read: Is a directory"
    if words == "report {}":  # a folder stands for all of its recordings
        folder = "contains no recordings"
    for name, message in [
        ("lost.mcap", "lost.mcap: no such file"),
        ("folder.mcap", f"folder.mcap: {folder}"),
        ("text.mcap", "text.mcap: is not an MCAP file"),
        ("pipe.mcap", "pipe.mcap: cannot be read: Not a regular file"),
    ]:
        refused(message, *words.format(name).split())


def test_schema(refused):
    message = "lost/schema.json: cannot be written: No such file or directory"
    refused(message, "schema", "--output", "lost/schema.json")


def test_unknown_option(hilctl, place):
    ended = hilctl("run", "--speed", "11", "--json")
    assert ended.code == 2
    assert "--speed" in ended.err
    assert "--speed" in json.loads(ended.out)["error"]
    assert "Traceback" not in ended.err
    assert contents(place) == {}


@pytest.mark.slow
def test_process(tmp_path):
    (tmp_path / "x.yaml").write_text(GOOD.replace("amplitude: 1.0", "amplitude: .nan"))
    before = contents(tmp_path)
    command = [sys.executable, "-m", "hilctl", "run", "x.yaml", "--json"]
    ended = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=240.0)
    message = "x.yaml:5: waveform.amplitude: must be a finite number, got nan"
    check_refused(Ended(ended.returncode, ended.stdout, ended.stderr), message)
    assert ended.stdout
    assert contents(tmp_path) == before
