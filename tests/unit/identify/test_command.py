"""The identify command's work: tables in, model, figures and page out."""

import json
from pathlib import Path

import numpy as np
import pytest

from hilctl.base.errors import InputError
from hilctl.cli.identify_view import print_finding
from hilctl.identify.command import find
from hilctl.identify.page import write_finding
from hilctl.identify.request import Request
from hilctl.models.files import load_model
from hilctl.models.ppi import PpiModel

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


def request(**choices: object) -> Request:
    return Request(
        kind="ppi", weights="free", offset=True, unit="V", command_column="drive",
        displacement_column="um", rate_hz=200.0, ignore=10, whole=True, **choices,  # type: ignore[arg-type]
    )  # fmt: skip


def test_order_and_lag_are_found_and_told(
    tables: list[Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """With plays and lag on auto, the model is written, and figures, page and JSON say what was
    chosen."""
    output, page = tmp_path / "model.yaml", tmp_path / "page.html"
    asked = request(plays="auto", lag_samples="auto", scheduler="threads")
    finding = find(
        tables[:3] + tables[3:], asked, output, validate=tables[:1], overwrite=False, quiet=True
    )
    assert finding.lag_samples == 2
    assert finding.fit.peak_percent < 2.0
    model = load_model(output)
    assert model == finding.fit.model
    assert model.operators in {order.plays for order in finding.orders}
    mapping = json.loads(json.dumps(finding.to_mapping(), allow_nan=False))
    assert mapping["lag_samples"] == 2
    assert len(mapping["orders"]) == len(finding.orders)
    print_finding(finding, output)
    told = capsys.readouterr().out
    assert "loops held out" in told
    assert "2 samples later" in told
    write_finding(finding, page)
    text = page.read_text()
    assert text.count("data:image/png;base64,") == 2
    assert "sine3.csv" in text
    assert "<script" not in text
    with pytest.raises(InputError, match="exists already"):
        find(tables, asked, output, overwrite=False, quiet=True)


def test_contradicting_requests_are_refused() -> None:
    """Deadbands can't be given where the order is found; a number of plays is kept."""
    with pytest.raises(InputError, match="--plays auto finds the number of deadbands"):
        Request(plays="auto", deadbands=4).settings("A")
    assert request(plays=7).settings(None).plays == 7
    with pytest.raises(InputError, match="--unit must be A"):
        request().settings("A")


def test_staged_request_has_its_stages_unless_told_otherwise() -> None:
    """A staged model has lag, structure and delay by default, and each can be left out."""
    full = Request(kind="staged").settings("A")
    assert (full.lag, full.structure, full.delay) == ("growth", True, True)
    less = Request(kind="staged", lag="none", structure=False, delay=False).settings("A")
    assert (less.lag, less.structure, less.delay) == ("none", False, False)
