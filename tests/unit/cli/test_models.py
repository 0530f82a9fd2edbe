"""Commands on models: identify, refine, compare, export-model."""

import json
from pathlib import Path

import pytest

from hilctl.base.errors import InputError
from hilctl.cli.models import _numbers, headings, notes, render_comparison, table_rows
from hilctl.experiment.examples import examples_folder
from hilctl.lab.comparison.compare import compare
from hilctl.lab.identify.data.data_files import LoadedRecords
from hilctl.lab.identify.settings import IdentifySettings
from hilctl.models.model_file import dump_model, load_model
from tests.fakes import SteppingClock
from tests.unit.lab.identify.test_refinement import OLD, actuator, history


def test_every_setting_is_listed(hilctl):
    shown = {*hilctl("identify", "--settings")[1].split()}
    assert {*IdentifySettings.model_fields.keys() - {"table", "own"}, "table.rate_hz"} <= shown


@pytest.fixture
def refine(monkeypatch, tmp_path, hilctl):
    """Return a function that refines a model with runs of another, and the new model's file."""
    (tmp_path / "old.yaml").write_text(dump_model(OLD))
    output = tmp_path / "better.yaml"

    def run(truth, *options):
        loaded = LoadedRecords([history(truth, seed) for seed in range(3)], "A", [])
        none = LoadedRecords([], None, [])
        monkeypatch.setattr(
            "hilctl.api.models.load_records", lambda paths, *_: loaded if paths else none
        )
        fitted = IdentifySettings(kind="rdpi", weights="free", starts=1, weight_by="equal")
        monkeypatch.setattr("hilctl.api.models.settings_from", lambda kind, texts: fitted)
        return hilctl("refine", tmp_path / "old.yaml", "run.mcap", "--output", output, *options)

    return run, output


@pytest.mark.usefixtures("undrawn")
def test_better_model_is_written(refine, tmp_path):
    run, output = refine
    code, shown, _ = run(actuator(), "--html", tmp_path / "page.html", "--json")
    printed = json.loads(shown)
    assert code == 0
    assert printed["output"] == str(output)
    assert printed["better"]
    assert printed["ratio"] < 0.5
    assert load_model(output).direct > OLD.direct
    assert (tmp_path / "page.html").exists()


def test_no_better_model_has_exit_code_1(refine):
    run, output = refine
    code, shown, _ = run(OLD)
    assert code == 1
    assert not output.exists()
    assert "not written" in shown


ROOT = Path(__file__).parents[3]
GOLDEN = ROOT / "recordings" / "golden" / "terfenol_uncompensated.mcap"
OMEGA = ROOT / "configs" / "models" / "terfenol_omega.yaml"


@pytest.fixture(scope="module")
def comparison():
    """Two models of the catalogue and one of a file, tested at 100 Hz."""
    models = ["spi", "straight", str(OMEGA)]
    return compare([GOLDEN], models, frequencies_hz=[100.0], clock=SteppingClock(1e-3))


def test_table_has_a_column_per_trial(comparison):
    rows = list(table_rows(comparison))
    assert headings(comparison)[-1] == "100 Hz"
    assert {len(row) for row in rows} == {len(headings(comparison))}
    assert rows[2][1:3] == ["-", "-"]
    assert render_comparison(comparison) is not None
    assert any("simulated" in note for note in notes(comparison))


def test_a_model_is_exported(hilctl, json_of, tmp_path):
    model, output = examples_folder() / "models" / "piezo_ppi.yaml", tmp_path / "piezo.c"
    assert json_of("export-model", model, output, "--rate-hz", 1e3) == (0, {"output": str(output)})
    assert "void piezo(" in output.read_text(encoding="utf-8")
    assert hilctl("export-model", model, output, "--rate-hz", 1e3)[0] == 2


def test_frequencies_are_numbers():
    assert _numbers(None) is None
    assert _numbers("1, 2.5,1e2") == [1.0, 2.5, 100.0]
    with pytest.raises(InputError, match="--frequencies"):
        _numbers("ten")
