"""The identify command's work: tables in, model, figures and page out."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from hilctl.base.errors import ConfigError, InputError
from hilctl.cli.models import print_identification
from hilctl.identify.command import identify_files, settings_from
from hilctl.identify.page import write_identification
from hilctl.identify.settings import IdentifySettings
from hilctl.models.files import load_model
from hilctl.models.plays import PpiModel

STAGE = PpiModel(input_unit="V", direct=1.0, weights=(0.6, 0.3, 0.2), thresholds=(0.3, 0.7, 1.2))


@pytest.fixture
def tables(tmp_path: Path) -> list[Path]:
    """Write four sines of rising amplitude, each displacement two samples late."""
    paths = []
    for i, amplitude in enumerate((0.8, 1.2, 1.6, 2.0)):
        time = np.arange(900)
        command = 2.0 + amplitude * np.sin(2.0 * np.pi * time / 200.0)
        late = np.roll(STAGE.forward(200.0).process(command), 2)
        path = tmp_path / f"sine{i}.csv"
        rows = "\n".join(
            f"{v!r},{y!r}" for v, y in zip(command.tolist(), late.tolist(), strict=True)
        )
        path.write_text(f"drive,um\n{rows}\n")
        paths.append(path)
    return paths


TABLE = ("table.unit=V", "table.command_column=drive", "table.displacement_column=um",
         "table.rate_hz=200", "table.ignore=10", "whole=true")  # fmt: skip


def settings(*texts: str) -> IdentifySettings:
    return settings_from("ppi", [*TABLE, "weights=free", "offset=true", *texts])


@pytest.mark.slow
@pytest.mark.usefixtures("undrawn")
def test_order_and_lag_are_found_and_reported(
    tables: list[Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """With plays and lag on auto, the model is written, and figures, page and JSON say what was
    chosen."""
    output, page = tmp_path / "model.yaml", tmp_path / "page.html"
    asked = settings("plays=auto", "table.lag_samples=auto")
    found = identify_files(tables, asked, output, validate=tables[:1], scheduler="threads")
    assert found.lag_samples == 2
    assert found.fit.peak_percent < 2.0
    model = load_model(output)
    assert model == found.fit.model
    assert model.operators in {order.plays for order in found.orders}
    mapping = json.loads(json.dumps(found.to_mapping(), allow_nan=False))
    assert mapping["lag_samples"] == 2
    assert len(mapping["orders"]) == len(found.orders)
    print_identification(found, output)
    shown = capsys.readouterr().out
    assert "validation loops" in shown
    assert "2 samples later" in shown
    write_identification(found, page)
    text = page.read_text()
    assert text.count("<svg") == 2
    assert "sine3.csv" in text
    assert "<script" not in text
    with pytest.raises(InputError, match="exists already"):
        identify_files(tables, asked, output)


def test_a_unit_that_was_not_recorded_is_refused() -> None:
    """The recordings know it better."""
    golden = Path(__file__).parents[3] / "recordings" / "golden" / "terfenol_uncompensated.mcap"
    with pytest.raises(InputError, match="--unit must be A"):
        identify_files([golden], settings_from("straight", ["table.unit=V"]), None)


def test_settings_are_checked_together() -> None:
    """Every broken rule is listed at once, with its key, its value and where it was given."""
    texts = ["plays=0", "weigths=free", "lag=none", "table.rate_hz=fast", "starts=2.5"]
    with pytest.raises(ConfigError) as caught:
        settings_from("ppi", texts)
    problems = {problem.key: str(problem) for problem in caught.value.problems}
    assert problems.keys() == {"plays", "weigths", "lag", "table.rate_hz", "starts"}
    assert problems["plays"] == "--set plays=0: plays: must be >= 1, got 0"
    assert "did you mean 'weights'" in problems["weigths"]
    assert "is a setting of staged, not of ppi" in problems["lag"]
    with pytest.raises(InputError, match=r"unknown kind of model 'presach' .*'preisach'"):
        settings_from("presach", [])


@pytest.mark.slow
def test_histories_import_neither_plots_nor_statistics(tables: list[Path]) -> None:
    """They would take longer than the fit of a small table, and 80 MB."""
    code = (
        "import sys\nfrom hilctl.cli import main\ntry:\n    main()\nfinally:\n"
        "    print([m for m in ('matplotlib', 'scipy.stats') if m in sys.modules])"
    )
    words = ["identify", str(tables[0]), "--model", "ppi"]
    words += [word for text in TABLE for word in ("--set", text)]
    done = subprocess.run(
        [sys.executable, "-c", code, *words], capture_output=True, text=True, timeout=120
    )
    assert "fitted: " in done.stdout, done.stderr
    assert done.stdout.splitlines()[-1] == "[]"
