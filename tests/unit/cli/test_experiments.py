"""Commands for a first experiment: demo, examples, init, schema."""

import json
import signal
import sys
from pathlib import Path

import pytest
import typer

from hilctl.base.errors import InputError
from hilctl.cli.experiments import demo, examples, init, schema
from hilctl.experiment.file import schema_text
from hilctl.experiment.load import load_experiment
from hilctl.run.result import RunResult

GOLDEN = Path(__file__).parents[3] / "recordings" / "golden" / "terfenol_uncompensated.mcap"


def test_examples_are_listed(capsys):
    examples()
    printed = capsys.readouterr().out
    assert "terfenol_sweep_6a" in printed
    assert "hilctl examples NAME" in printed
    examples(as_json=True)
    listed = json.loads(capsys.readouterr().out)["examples"]
    assert "demo" in [example["name"] for example in listed]
    assert all(Path(example["path"]).is_file() for example in listed)


def test_copied_files_are_printed(tmp_path, capsys):
    examples("demo", into=tmp_path)
    assert str(tmp_path / "models" / "terfenol_staged.yaml") in capsys.readouterr().out
    examples("demo", into=tmp_path, as_json=True)
    copied = json.loads(capsys.readouterr().out)
    assert copied["example"] == "demo"
    assert str(tmp_path / "demo.yaml") in copied["files"]


@pytest.fixture
def runs(tmp_path, monkeypatch):
    """Replace runs by copies of a golden recording; return their arguments and result."""
    seen, ends = [], {"code": "completed", "stop_signal": 0}

    def start_run(experiment, settings, output, overwrite, on_progress):
        path = tmp_path / f"{len(seen)}.mcap"
        path.write_bytes(GOLDEN.read_bytes())
        seen.append((experiment.name, settings))
        return RunResult(path, ends["code"], "because", "confirmed", ends["stop_signal"], 0, 0, 0)

    monkeypatch.setattr("hilctl.api.runs.start_run", start_run)

    def write(contents, summary, page, before):
        page.write_text(f"{summary.name}{' beside the one before' if before else ''}")

    monkeypatch.setattr("hilctl.api.reports.write_html", write)
    return seen, ends


def test_demo_runs_without_and_with_the_inverse(tmp_path, runs, capsys):
    demo(tmp_path / "d", as_json=True)
    seen, _ = runs
    assert [name for name, _ in seen] == ["terfenol_sine_6a_uncompensated.yaml", "demo.yaml"]
    assert "waveform.frequency_hz=50" in seen[0][1]
    found = json.loads(capsys.readouterr().out)
    for which, beside in (("without", ""), ("with", " beside the one before")):
        assert found[which]["code"] == "completed"
        assert found[which]["peak_hysteresis_percent"] > 0.0
        assert Path(found[which]["page"]).read_text() == f"terfenol_sine_6a_uncompensated{beside}"


@pytest.mark.parametrize(("code", "stop_signal", "left"), [("fault", 0, 3), ("stopped", 2, 130)])
def test_exit_code_of_demo(tmp_path, runs, code, stop_signal, left):
    seen, ends = runs
    ends.update(code=code, stop_signal=stop_signal)
    with pytest.raises(typer.Exit) as error:
        demo(tmp_path / "d")
    assert error.value.exit_code == left
    assert len(seen) == (1 if stop_signal == signal.SIGINT else 2)


@pytest.fixture
def here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_init_lists_required_values(here, capsys):
    init("labjack_t7", settings=["device.host=10.0.0.5", "device.amplifier.gain_a_per_v=2"])
    said = capsys.readouterr().out
    assert "set device.sensor.um_per_v" in said
    assert "device.host" not in said
    assert load_experiment(here / "labjack_t7.yaml").document.data["device"]["host"] == "10.0.0.5"
    assert (here / "schema.json").stat().st_size > 0


def test_init_prints_one_json_object(here, capsys):
    init("simulated_piezo", output=here / "p.yaml", as_json=True)
    found = json.loads(capsys.readouterr().out)
    assert found["experiment"] == str(here / "p.yaml")
    assert found["to_be_set"] == []


def test_init_refuses_existing_files(here):
    (here / "simulated_piezo.yaml").write_text("mine")
    with pytest.raises(InputError, match="exists"):
        init("simulated_piezo")
    assert (here / "simulated_piezo.yaml").read_text() == "mine"


def test_init_refuses_invalid_settings(here):
    with pytest.raises(InputError, match="within"):
        init("simulated_terfenol", settings=["limits.peak_current_a=50"])
    assert not list(here.iterdir())


def test_init_needs_a_device(here):
    with pytest.raises(InputError, match=r"DEVICE.*labjack_t7"):
        init()


def test_init_asks_in_a_terminal(here, monkeypatch, capsys):
    """An empty answer keeps the default."""
    answers = {
        "device, profile": "labjack_t7",
        "name or address": "10.0.0.7",
        "largest current": "0.4",
    }
    asked = []

    def prompt(text, **more):
        asked.append(text)
        return next((each for key, each in answers.items() if text.startswith(key)), "")

    monkeypatch.setattr(typer, "prompt", prompt)
    monkeypatch.setattr(sys.stdin, "isatty", lambda: True)
    monkeypatch.setattr(sys.stdout, "isatty", lambda: True)
    init()
    config = load_experiment(here / "labjack_t7.yaml")
    assert config.document.data["device"]["host"] == "10.0.0.7"
    assert config.config.limits.peak_current_a == 0.4
    assert "displacement of one V of the sensor, um [10.0]" in asked


def test_schema_is_printed_or_written(tmp_path, capsys):
    schema(None)
    assert capsys.readouterr().out == schema_text()
    schema(tmp_path / "schema.json")
    assert (tmp_path / "schema.json").read_text() == schema_text()
