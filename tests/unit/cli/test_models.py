"""Commands that identify models: identify, refine, compare."""

import json
from pathlib import Path

import pytest
import typer

from hilctl.base.errors import InputError
from hilctl.cli.models import (
    _column,
    _numbers,
    headings,
    notes,
    print_settings,
    refine,
    render_comparison,
    table_rows,
)
from hilctl.comparison.compare import ComparisonRequest, compare
from hilctl.identify.settings import IdentifySettings
from hilctl.models.model_file import dump_model, load_model
from tests.fakes import SteppingClock
from tests.unit.identify.refine.conftest import OLD, actuator, history


def test_every_setting_is_listed(capsys: pytest.CaptureFixture[str]) -> None:
    print_settings()
    shown = {*capsys.readouterr().out.split()}
    assert {*IdentifySettings.model_fields.keys() - {"table"}, "table.rate_hz"} <= shown


def given(monkeypatch, tmp_path, truth):
    """Replace the runs to load; return model file, paths and output."""
    runs = [history(truth, i, noise_um=0.05) for i in range(4)]
    monkeypatch.setattr("hilctl.identify.refine.refinement.load_runs", lambda paths, model: runs)
    (tmp_path / "old.yaml").write_text(dump_model(OLD))
    return tmp_path / "old.yaml", [Path(f"{i}.mcap") for i in range(4)], tmp_path / "better.yaml"


@pytest.mark.slow
@pytest.mark.usefixtures("undrawn")
def test_better_model_is_written(monkeypatch, tmp_path, capsys):
    model, runs, output = given(monkeypatch, tmp_path, actuator())
    refine(model, runs, output, html=tmp_path / "page.html", as_json=True)
    printed = json.loads(capsys.readouterr().out)
    assert printed["output"] == str(output)
    assert printed["better"]
    assert printed["ratio"] < 0.5
    assert load_model(output).operators > OLD.operators
    assert (tmp_path / "page.html").exists()


@pytest.mark.slow
def test_no_better_model_has_exit_code_1(monkeypatch, tmp_path, capsys):
    model, runs, output = given(monkeypatch, tmp_path, OLD)
    with pytest.raises(typer.Exit) as ended:
        refine(model, runs, output)
    assert ended.value.exit_code == 1
    assert not output.exists()
    printed = capsys.readouterr().out
    assert "no better" in printed
    assert "not written" in printed


ROOT = Path(__file__).parents[3]


GOLDEN = ROOT / "recordings" / "golden" / "terfenol_uncompensated.mcap"


OMEGA = ROOT / "configs" / "models" / "terfenol_omega.yaml"


def ignore(done, text):
    """Ignore progress."""


@pytest.fixture(scope="module")
def comparison():
    """Two models of the catalogue and one of a file, tested at 100 Hz."""
    request = ComparisonRequest([GOLDEN], ["duhem", "straight", str(OMEGA)], frequencies_hz=[100.0])
    return compare(request, SteppingClock(1e-3), ignore)


def test_table_has_a_column_per_trial(comparison):
    rows = list(table_rows(comparison))
    assert headings(comparison)[-1] == "100 Hz"
    assert {len(row) for row in rows} == {len(headings(comparison))}
    assert rows[2][1:3] == ["-", "-"]
    assert render_comparison(comparison) is not None
    assert any("simulated" in note for note in notes(comparison))


def test_frequencies_are_numbers():
    assert _numbers(None) is None
    assert _numbers("1, 2.5,1e2") == [1.0, 2.5, 100.0]
    with pytest.raises(InputError, match="--frequencies"):
        _numbers("ten")


@pytest.mark.parametrize(("text", "column"), [("3", 3), ("drive", "drive"), (None, None)])
def test_column_is_a_number_or_a_name(text, column):
    assert _column(text) == column
