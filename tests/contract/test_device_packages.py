"""Devices of other packages whose code fails, exits or does not return: a message names them."""

import json
import subprocess
import sys

import pytest
import yaml

from hilctl.base import alarm
from hilctl.recording.reader import read
from hilctl.run import unpaced
from tests import device_packages
from tests.commands import in_process

EXPERIMENT = {
    "name": "broken",
    "device": {"kind": "broken"},
    "sample_rate_hz": 200,
    "waveform": {"kind": "sine", "unit": "V", "amplitude": 1.0, "offset": 5.0,
                 "frequency_hz": 4.0, "duration_s": 0.5, "soft_start_s": 0.1},
    "compensator": "none",
    "limits": {"drive_v": [0.0, 10.0], "slew_v_per_s": 500.0, "stroke_um": [-1.0, 10.5]},
}  # fmt: skip
SWEEP = ("--vary", "waveform.frequency_hz=4", "--fast", "--folder", "sweep")


@pytest.fixture
def experiment(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    path = tmp_path / "broken.yaml"
    path.write_text(yaml.safe_dump(EXPERIMENT), encoding="utf-8")
    return path


@pytest.fixture
def ended(monkeypatch, capsys):
    """Return a function that runs a command with a broken device; return code and output."""
    device_packages.installed_here("broken_device", monkeypatch)
    hilctl = in_process(monkeypatch, capsys)

    def run(*words, **device):
        settings = [f"--set=device.{key}={value}" for key, value in device.items()]
        found = hilctl(*words, *settings)
        assert "Traceback" not in found.out + found.err
        return found.code, found.out + found.err

    return run


@pytest.fixture
def impatient(monkeypatch):
    for module in (alarm, unpaced):
        monkeypatch.setattr(module, "PATIENCE_S", 0.5)


@pytest.mark.parametrize("kind", ["load_raises", "load_exits", "no_class"])
def test_a_module_that_does_not_load(ended, experiment, kind):
    place = device_packages.project("broken_device")["entry-points"]["hilctl.devices"][kind]
    for words in (("check", experiment), ("devices", "show", kind)):
        settings = {"kind": kind} if words[0] == "check" else {}
        code, said = ended(*words, **settings)
        assert code == 2
        assert f"'{kind}' ({place})" in said


def test_a_schema_with_a_broken_device_names_it(ended):
    code, said = ended("schema")
    assert code == 2
    assert "broken_device.load_" in said


@pytest.mark.parametrize("how", ["raises", "exits"])
@pytest.mark.parametrize(("at", "codes"), [
    ("init", {"check": 2, "sweep": 2, "safe": 2, "devices": 2}),
    ("info", {"check": 2, "sweep": 2, "safe": 2, "devices": 2}),
    ("check_rate", {"check": 2, "sweep": 2, "safe": 0, "devices": 0}),
    ("open", {"check": 0, "sweep": 3, "safe": 0, "devices": 3}),
    ("output", {"check": 0, "sweep": 3, "safe": 0, "devices": 3}),
    ("exchange", {"check": 0, "sweep": 3, "safe": 0, "devices": 0}),
    ("make_safe", {"check": 0, "sweep": 0, "safe": 3, "devices": 0}),
    ("close", {"check": 0, "sweep": 3, "safe": 0, "devices": 3}),
])  # fmt: skip
def test_a_method_that_fails_or_exits(ended, experiment, monkeypatch, at, how, codes):
    monkeypatch.setattr("hilctl.loop.safe_output.PATIENCE_S", 0.0)
    for name, expected in codes.items():
        words = {"sweep": SWEEP, "devices": ()}.get(name, ())
        first = ("devices", "probe") if name == "devices" else (name,)
        code, said = ended(*first, experiment, *words, at=at, how=how)
        assert code == expected, said
        if code:
            assert "broken_device.device:Broken" in said
            assert {"raises": "RuntimeError: no licence", "exits": "SystemExit"}[how] in said
        if code == 2:
            assert not (experiment.parent / "sweep").exists()


@pytest.mark.parametrize(("device", "code"), [
    ({"kind": "load_hangs"}, 2), ({"at": "init"}, 2), ({"at": "info"}, 2),
    ({"at": "open"}, 3), ({"at": "exchange"}, 3), ({"at": "close"}, 3),
])  # fmt: skip
def test_code_that_does_not_return(ended, experiment, impatient, device, code):
    found, said = ended("sweep", experiment, *SWEEP, how="hangs", **device)
    assert found == code
    assert "TimeoutError" in said
    assert "broken_device." in said


@pytest.mark.parametrize("at", ["exchange", "close"])
def test_its_run_without_real_time_is_recorded(ended, experiment, tmp_path, at):
    ended("sweep", experiment, *SWEEP, at=at)
    (path,) = (tmp_path / "sweep").glob("*.mcap")
    recording = read(path)
    assert recording.end["code"] == "fault"
    assert recording.samples.index.size >= 20


@pytest.mark.slow
@pytest.mark.parametrize(("at", "how"), [
    ("open", "exits"), ("exchange", "exits"), ("exchange", "raises"), ("exchange", "hangs"),
    ("close", "exits"),
])  # fmt: skip
def test_its_run_in_real_time_ends_safely(experiment, tmp_path, at, how):
    environment = device_packages.installed("broken_device", tmp_path / "site")
    settings = [f"--set=device.at={at}", f"--set=device.how={how}"]
    words = ["run", experiment, "--output", "run.mcap", "--json", *settings]
    command = [sys.executable, "-P", "-m", "hilctl", *map(str, words)]
    done = subprocess.run(command, capture_output=True, text=True, env=environment)
    assert done.returncode == 3, done.stderr
    assert "Traceback" not in done.stderr
    said = json.loads(done.stdout)
    if at == "open":
        assert "broken_device.device:Broken" in said["error"]
        return
    assert (said["code"], said["output_safe"]) == ("fault", True)
    assert how == "hangs" or "broken_device.device:Broken" in said["reason"]
    assert read(tmp_path / "run.mcap").samples.index.size >= 20
