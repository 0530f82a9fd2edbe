"""Commands for a first experiment: demo, examples, init, schema."""

import io
import signal
import sys
from pathlib import Path

import pytest

from hilctl.cli.experiments import init
from hilctl.experiment.file import schema_text
from hilctl.experiment.load import load_experiment
from hilctl.run.result import RunResult

GOLDEN = Path(__file__).parents[3] / "recordings" / "golden" / "terfenol_uncompensated.mcap"


def test_examples_are_listed(hilctl, json_of):
    shown = hilctl("examples")[1]
    assert "terfenol_sweep_6a" in shown
    assert "hilctl examples NAME" in shown
    listed = json_of("examples")[1]["examples"]
    assert "demo" in [example["name"] for example in listed]
    assert all(Path(example["path"]).is_file() for example in listed)


def test_copied_files_are_printed(tmp_path, hilctl, json_of):
    words = ("examples", "demo", "--into", tmp_path)
    assert str(tmp_path / "models" / "terfenol_staged.yaml") in hilctl(*words)[1]
    _, copied = json_of(*words)
    assert copied["example"] == "demo"
    assert str(tmp_path / "demo.yaml") in copied["files"]


@pytest.fixture
def runs(tmp_path, monkeypatch):
    """Replace runs by copies of a golden recording; return their arguments and result."""
    seen, ends = [], {"code": "completed", "stop_signal": 0}

    def start_run(experiment, settings, output, overwrite, on_progress, *, take_over):
        path = tmp_path / f"{len(seen)}.mcap"
        path.write_bytes(GOLDEN.read_bytes())
        seen.append((experiment.name, settings))
        return RunResult(path, ends["code"], "because", "confirmed", ends["stop_signal"], 0, 0, 0)

    monkeypatch.setattr("hilctl.api.runs.start_run", start_run)

    def page(contents, summary, before):
        return f"{summary.name}{' beside the one before' if before else ''}"

    monkeypatch.setattr("hilctl.api.reports.page", page)
    return seen, ends


def test_demo_runs_without_and_with_the_inverse(tmp_path, runs, json_of):
    _, found = json_of("demo", "--folder", tmp_path / "d")
    seen, _ = runs
    assert [name for name, _ in seen] == ["terfenol_sine_6a_uncompensated.yaml", "demo.yaml"]
    assert "waveform.frequency_hz=50" in seen[0][1]
    for which, beside in (("without", ""), ("with", " beside the one before")):
        assert found[which]["code"] == "completed"
        assert found[which]["peak_hysteresis_percent"] > 0.0
        assert Path(found[which]["page"]).read_text() == f"terfenol_sine_6a_uncompensated{beside}"


@pytest.mark.parametrize(("code", "stop_signal", "left"), [("fault", 0, 3), ("stopped", 2, 130)])
def test_exit_code_of_demo(tmp_path, hilctl, runs, code, stop_signal, left):
    seen, ends = runs
    ends.update(code=code, stop_signal=stop_signal)
    assert hilctl("demo", "--folder", tmp_path / "d")[0] == left
    assert len(seen) == (1 if stop_signal == signal.SIGINT else 2)


@pytest.fixture
def here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_init_lists_required_values(here, hilctl):
    settings = ("--set", "device.host=10.0.0.5", "--set", "device.amplifier.gain_a_per_v=2")
    _, shown, _ = hilctl("init", "labjack_t7", *settings)
    assert "set device.sensor.um_per_v" in shown
    assert "device.host" not in shown
    assert load_experiment(here / "labjack_t7.yaml").document.data["device"]["host"] == "10.0.0.5"
    assert (here / "schema.json").stat().st_size > 0


def test_init_prints_one_json_object(here, json_of):
    _, found = json_of("init", "simulated_piezo", "--output", here / "p.yaml")
    assert found["experiment"] == str(here / "p.yaml")
    assert found["to_be_set"] == []


@pytest.mark.parametrize(("words", "message"), [
    (["simulated_piezo"], "exists"),
    (["simulated_terfenol", "--set", "limits.peak_current_a=50"], "-50 to 50"),
    ([], "labjack_t7"),
])  # fmt: skip
def test_init_refuses_wrong_input_and_existing_files(here, hilctl, words, message):
    (here / "simulated_piezo.yaml").write_text("mine")
    code, _, err = hilctl("init", *words)
    assert (code, message in err) == (2, True)
    assert [each.read_text() for each in here.iterdir()] == ["mine"]


class Terminal(io.StringIO):
    """Scripted answers; an extra question aborts."""

    def isatty(self):
        return True


@pytest.mark.parametrize(("answers", "errors", "chosen"), [
    ("labjack|t9|labjack_t7||DAC9|dac1||kV|A|10.0.0.7|zero|0|2|-5|||50|0.4",
     ["3 devices", "0 devices", "'DAC9'", "'kV'", "'zero'", "not 0", "-50 to 50"], {
     "device": {"host": "10.0.0.7", "output": "DAC1"}, "limits": {"peak_current_a": 0.4},
     "waveform": {"amplitude": 0.2}, }),
    ("tdk||agilent||/dev/ttyUSB1|||5|[0, 5]", ["--reader", "[-5, 5]"],
     {"device": {"input": "AI101"}, "limits": {"drive_a": (0, 5)}}),
    ("piezo|[0, 50]", [], {"limits": {"drive_v": (0, 50)}}),
])  # fmt: skip
def test_init_asks_until_it_is_valid(here, monkeypatch, capsys, answers, errors, chosen):
    monkeypatch.setattr(sys, "stdin", Terminal(answers.replace("|", "\n") + "\n"))
    monkeypatch.setattr(sys.stdout, "isatty", lambda: True)
    init()
    assert not sys.stdin.read()
    shown = capsys.readouterr().out
    assert [each for each in errors if each not in shown] == []
    assert shown.count("Error: ") == len(errors)
    (path,) = here.glob("*.yaml")
    data = load_experiment(path).document.data
    assert {key: {name: data[key][name] for name in part} for key, part in chosen.items()} == chosen


def test_schema_is_printed_or_written(tmp_path, hilctl):
    assert hilctl("schema")[1] == schema_text()
    hilctl("schema", "--output", tmp_path / "schema.json")
    assert (tmp_path / "schema.json").read_text() == schema_text()
