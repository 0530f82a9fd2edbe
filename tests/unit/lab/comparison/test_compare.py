"""The comparison as a whole, on the tracked recordings."""

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest

from hilctl.base.errors import InputError
from hilctl.lab.comparison.compare import headings, notes, save_models, table_rows
from hilctl.lab.comparison.comparison_page import comparison_page
from hilctl.models.model_file import load_model
from hilctl.recording.reader import read
from tests.unit.lab.comparison.conftest import GOLDEN, ROOT, compared


def test_rows_come_as_asked_for(comparison):
    assert [row.name for row in comparison.rows] == ["duhem", "straight", "terfenol_omega.yaml"]
    assert [row.numbers for row in comparison.rows] == [4, 2, None]
    assert comparison.rows[2].identify_s is None
    assert comparison.rows[0].identify_s == pytest.approx(1e-3)


def test_better_models_compensate_better(comparison):
    duhem, straight, omega = comparison.rows
    assert omega.error.peak_percent < duhem.error.peak_percent < straight.error.peak_percent
    assert omega.compensated_percent < duhem.compensated_percent < straight.compensated_percent


def test_everything_goes_into_json(comparison):
    mapping = json.loads(json.dumps(comparison.to_mapping(), allow_nan=False))
    first = mapping["models"][0]
    assert first["model"]["kind"] == "duhem"
    assert [loop["label"] for loop in first["loops"]] == mapping["loops"]
    assert first["compensated"][0]["frequency_hz"] == pytest.approx(100.0)
    assert "simulated" in mapping["device"]


@pytest.mark.slow
@pytest.mark.parametrize("text", ["", "device: {kind: serial_dac, port: /dev/ttyUSB9}"])
def test_loops_of_a_real_device_are_compared_without_trials(monkeypatch, text):
    recording = read(GOLDEN)
    run = {**recording.run, "simulated": "false"}
    recording = replace(recording, experiment_yaml=text, run=run)
    monkeypatch.setattr("hilctl.lab.comparison.compare.read", lambda path: recording)
    judged = compared()
    assert judged.rows[0].trials == ()
    assert judged.rows[0].compensated_percent is None
    assert judged.to_mapping()["device"] is None
    assert any("not simulated" in note for note in notes(judged))
    assert "straight" in comparison_page(judged)


def test_a_compensated_recording_gives_device_and_limits(monkeypatch):
    path = GOLDEN.with_name("terfenol_compensated.mcap")
    recording = read(path)
    text = recording.experiment_yaml + "timing: {late_policy: skip}\n"  # of an earlier release
    recording = replace(recording, experiment_yaml=text)
    monkeypatch.setattr("hilctl.lab.comparison.compare.read", lambda path: recording)
    judged = compared(path, frequencies_hz=[200.0])
    assert judged.rows[0].trials[0].frequency_hz == pytest.approx(200.0)


def test_inverses_are_tried_at_the_frequencies_of_the_data():
    judged = compared()
    recorded = {round(loop.frequency_hz, 3) for loop in judged.loops}
    assert {round(trial.frequency_hz, 3) for trial in judged.rows[0].trials} <= recorded


def test_unknown_models_are_refused_at_once():
    with pytest.raises(InputError, match="did you mean 'preisach'"):
        compared(Path("nowhere.mcap"), ["presach"])


def test_a_model_of_another_unit_is_refused():
    model = ROOT / "configs" / "models" / "piezo_ppi.yaml"
    with pytest.raises(InputError, match="commands in A"):
        compared(models=[str(model)])


def test_saved_models_are_model_files(comparison, tmp_path):
    save_models(comparison, tmp_path / "models", created="2026-01-01", overwrite=False)
    paths = sorted((tmp_path / "models").iterdir())
    assert [path.name for path in paths] == ["duhem.yaml", "straight.yaml"]
    for path, row in zip(paths, comparison.rows, strict=False):
        saved = load_model(path)
        assert saved.model_copy(update={"provenance": row.model.provenance}) == row.model
        assert saved.provenance.source == (GOLDEN.name,)
        assert saved.provenance.created == "2026-01-01"
        assert saved.provenance.errors_percent["peak"] == row.error.peak_percent
    with pytest.raises(InputError, match="overwrite"):
        save_models(comparison, tmp_path / "models", created="2026-01-01", overwrite=False)


def trial(frequency_hz, error_percent, limited=0):
    return SimpleNamespace(
        frequency_hz=frequency_hz, peak_error_percent=error_percent, limited_samples=limited
    )


def row(name, *trials, numbers=5, identify_s=1.5):
    error = SimpleNamespace(peak_percent=1.25)
    return SimpleNamespace(
        name=name, title=f"the {name}", numbers=numbers, identify_s=identify_s, inverse_ns=312.4,
        error=error, trials=trials,
    )  # fmt: skip


def table(*rows, device="a rig"):
    return SimpleNamespace(rows=rows, device=device)


def test_a_model_of_a_file_has_dashes_where_nothing_was_found():
    found = table(
        row("duhem", trial(50.0, 0.75), trial(100.0, None)),
        row("m.yaml", numbers=None, identify_s=None),
    )
    assert headings(found)[-2:] == ["50 Hz", "100 Hz"]
    assert list(table_rows(found)) == [
        ["duhem", "5", "1.50", "312", "1.25", "0.75", "-"],
        ["m.yaml", "-", "-", "312", "1.25"],
    ]


def test_a_trial_that_was_limited_has_a_star_and_a_note():
    limited = table(row("duhem", trial(50.0, 0.75, limited=3)))
    assert next(table_rows(limited))[-1] == "0.75*"
    assert notes(limited)[-1].startswith("*: the limiter")
    assert not any(text.startswith("*") for text in notes(table(row("d", trial(50.0, 1.0)))))
