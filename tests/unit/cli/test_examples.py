"""Examples and the demonstration: what they print, and how they end."""

import json
import signal
from pathlib import Path

import pytest
import typer

from hilctl.cli.examples import demo, examples
from hilctl.run.result import RunResult

GOLDEN = Path(__file__).parents[3] / "recordings" / "golden" / "terfenol_uncompensated.mcap"


def test_a_list_of_them_for_people_and_for_programs(capsys):
    examples()
    printed = capsys.readouterr().out
    assert "terfenol_sweep_6a" in printed
    assert "hilctl examples NAME" in printed
    examples(as_json=True)
    listed = json.loads(capsys.readouterr().out)["examples"]
    assert "demo" in [example["name"] for example in listed]
    assert all(Path(example["path"]).is_file() for example in listed)


def test_copies_are_named(tmp_path, capsys):
    examples("demo", into=tmp_path)
    assert str(tmp_path / "models" / "terfenol_staged.yaml") in capsys.readouterr().out
    examples("demo", into=tmp_path, as_json=True)
    copied = json.loads(capsys.readouterr().out)
    assert copied["example"] == "demo"
    assert str(tmp_path / "demo.yaml") in copied["files"]


@pytest.fixture
def runs(tmp_path, monkeypatch):
    """Let each run leave a copy of a golden recording, and end as told."""
    seen, ends = [], {"code": "completed", "stop_signal": 0}

    def start_run(experiment, settings, output, overwrite, on_progress):
        path = tmp_path / f"{len(seen)}.mcap"
        path.write_bytes(GOLDEN.read_bytes())
        seen.append((experiment.name, settings))
        return RunResult(path, ends["code"], "because", "confirmed", ends["stop_signal"], 0, 0, 0)

    monkeypatch.setattr("hilctl.run.start.start_run", start_run)

    def write(contents, summary, page, before):
        page.write_text(f"{summary.name}{' beside the one before' if before else ''}")

    monkeypatch.setattr("hilctl.analysis.run_page.write_html", write)
    return seen, ends


def test_the_demonstration_runs_the_same_sine_without_and_with(tmp_path, runs, capsys):
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
def test_a_demonstration_that_did_not_end_well_says_so(tmp_path, runs, code, stop_signal, left):
    seen, ends = runs
    ends.update(code=code, stop_signal=stop_signal)
    with pytest.raises(typer.Exit) as error:
        demo(tmp_path / "d")
    assert error.value.exit_code == left
    assert len(seen) == (1 if stop_signal == signal.SIGINT else 2)
