"""The identify command's work: tables in, model, figures and page out."""

import json
import subprocess
import sys
from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from hilctl import api
from hilctl.base.errors import ConfigError, InputError
from hilctl.cli.models import print_identification
from hilctl.lab.identify import pipeline as subject
from hilctl.lab.identify.data.records import History, SteadyLoop
from hilctl.lab.identify.model_page import identification_page
from hilctl.lab.identify.model_selection import Selection
from hilctl.lab.identify.pipeline import TURNS, settings_from, with_modes
from hilctl.lab.identify.resonances import WORTH
from hilctl.lab.identify.settings import FitSettings
from hilctl.models.linear_stages import FirstMode, FurtherMode
from hilctl.models.model_file import load_model
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


@pytest.mark.slow
@pytest.mark.usefixtures("undrawn")
def test_lag_is_found_and_reported(tables, tmp_path, capsys):
    output = tmp_path / "model.yaml"
    asked = [*TABLE, "weights=free", "offset=true", "table.lag_samples=auto"]
    found = api.identify(
        tables, output, model="ppi", settings=asked, validate=tables[:1], scheduler="threads"
    )
    assert found.lag_samples == 2
    assert found.fit.peak_percent < 2.0
    model = load_model(output)
    assert model == found.fit.model
    mapping = json.loads(json.dumps(found.to_mapping(), allow_nan=False))
    assert mapping["lag_samples"] == 2
    print_identification(found, output)
    shown = capsys.readouterr().out
    assert "lag of the displacements: 2" in shown
    text = identification_page(found)
    assert "<svg" in text
    assert "sine3.csv" in text
    assert "<script" not in text
    with pytest.raises(InputError, match="exists already"):
        api.identify(tables, output, model="ppi", settings=asked)


def test_a_unit_that_was_not_recorded_is_refused():
    golden = Path(__file__).parents[4] / "recordings" / "golden" / "terfenol_uncompensated.mcap"
    with pytest.raises(InputError, match="unit must be A"):
        api.identify(golden, model="straight", settings=["table.unit=V"])


def test_settings_are_checked_together():
    texts = ["plays=0", "weigths=free", "lines=8", "lag=none", "table.rate_hz=fast", "starts=2.5"]
    with pytest.raises(ConfigError) as caught:
        settings_from("ppi", texts)
    problems = {problem.key: str(problem) for problem in caught.value.problems}
    assert problems.keys() == {"plays", "weigths", "lines", "lag", "table.rate_hz", "starts"}
    assert problems["plays"] == "setting plays=0: plays: must be >= 1, got 0"
    assert "'weights'" in problems["weigths"]
    assert "preisach" in problems["lines"]
    assert "--model staged" in problems["lag"]
    with pytest.raises(InputError, match=r"'presach' .*'preisach'"):
        settings_from("presach", [])


@pytest.mark.slow
def test_histories_import_neither_plots_nor_statistics(tables):
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


FIELD = FitSettings(kind="field")
MODE = FurtherMode(
    natural_hz=600.0, damping_ratio=0.03, antiresonance_hz=630.0, antiresonance_damping_ratio=0.03
)
FIRST = FirstMode(natural_hz=2000.0, damping_ratio=0.1)
TIME = np.arange(200) / 200
RECORD = History("h", np.sin(6.3 * TIME), np.sin(6.3 * TIME), 1000.0)


@dataclass
class Found:
    """A model as it is found, with modes that were known."""

    fit_percent: float
    held_out_percent: float | None = None
    modes: tuple = ()
    first: FirstMode | None = FIRST
    settings: FitSettings = FIELD

    @property
    def fit(self):
        model = SimpleNamespace(structure=self.first, modes=self.modes)
        um = (RECORD.displacement_um,)
        return SimpleNamespace(model=model, rms_percent=self.fit_percent, modelled_um=um)

    @property
    def selection(self):
        return Selection(self.settings)

    @property
    def rms_percent(self):
        return self.fit_percent if self.held_out_percent is None else self.held_out_percent


def identifying(*found):
    """Return what finds models one after the other, with the modes that it was given."""
    left = iter(found)
    return lambda modes, selection: replace(next(left), modes=tuple(modes))


@pytest.fixture
def asked(monkeypatch):
    """Have a mode more proposed each time, and note what was asked with."""
    seen = []

    def propose(records, modelled_um, known, first_hz):
        seen.append((len(known), first_hz))
        return (*known, MODE)

    monkeypatch.setattr(subject, "further_modes", propose)
    return seen


def test_modes_are_kept_for_as_long_as_data_held_out_are_the_better(asked):
    stiffer = FirstMode(natural_hz=2200.0, damping_ratio=0.1)
    found = with_modes(
        [RECORD], identifying(Found(1.0, 1.0), Found(0.9, 0.5, first=stiffer), Found(0.1, 0.46))
    )
    assert (found.modes, found.held_out_percent) == ((MODE,), 0.5)
    assert asked == [(0, 2000.0), (1, 2200.0)]


@pytest.mark.parametrize(("models", "modes", "rms_percent"), [
    ([Found(1.0, 1.0), Found(0.1, WORTH)], 0, 1.0),  # it helps only what was fitted
    ([Found(1.0), Found(0.5), Found(0.46)], 1, 0.5),  # nothing was held out
    ([Found(0.5**k) for k in range(20)], TURNS, 0.5**TURNS),
])  # fmt: skip
def test_modes_that_improve_little_are_left_out(asked, models, modes, rms_percent):
    found = with_modes([RECORD], identifying(*models))
    assert (found.modes, found.rms_percent) == ((MODE,) * modes, rms_percent)


def test_it_begins_with_measured_modes(monkeypatch):
    monkeypatch.setattr(subject, "further_modes", lambda *known: None)
    assert with_modes([RECORD], identifying(Found(1.0)), (MODE,)).modes == (MODE,)


def test_it_ends_where_no_mode_shows(monkeypatch):
    asked = []
    monkeypatch.setattr(subject, "further_modes", lambda *known: asked.append(known))
    assert with_modes([RECORD], identifying(Found(1.0))).modes == ()
    assert len(asked) == 1


def test_a_model_without_a_structure_has_no_first_mode(asked):
    with_modes([RECORD], identifying(Found(1.0, first=None), Found(1.0)))
    assert asked == [(0, None)]


@pytest.mark.parametrize(("records", "settings"), [
    ([RECORD], FitSettings(kind="field", modes=False)),
    ([RECORD], FitSettings(kind="ppi")),
    ([RECORD, SteadyLoop("l", TIME, TIME, 10.0)], FIELD),
])  # fmt: skip
def test_nothing_is_looked_for_where_it_is_not_asked_for_or_can_not_be(records, settings, asked):
    assert with_modes(records, identifying(Found(1.0, settings=settings))).modes == ()
    assert not asked
