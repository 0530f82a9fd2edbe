"""Modes stay in a model only where data held out are the better for them."""

from dataclasses import dataclass, replace
from types import SimpleNamespace

import numpy as np
import pytest

from hilctl.identify import with_modes as subject
from hilctl.identify.data.records import History, SteadyLoop
from hilctl.identify.modes import WORTH
from hilctl.identify.settings import FitSettings
from hilctl.identify.with_modes import TURNS, with_modes
from hilctl.models.structure import Mode, Structure

FIELD = FitSettings(kind="field")
MODE = Mode(
    natural_hz=600.0, damping_ratio=0.03, antiresonance_hz=630.0, antiresonance_damping_ratio=0.03
)
FIRST = Structure(natural_hz=2000.0, damping_ratio=0.1)
TIME = np.arange(200) / 200
RECORD = History("h", np.sin(6.3 * TIME), np.sin(6.3 * TIME), 1000.0)


@dataclass
class Found:
    """A model as it is found, with modes that were known."""

    rms_percent: float
    held_out_percent: float | None = None
    modes: tuple = ()
    first: Structure | None = FIRST
    settings: FitSettings = FIELD

    @property
    def fit(self):
        model = SimpleNamespace(structure=self.first, modes=self.modes)
        um = (RECORD.displacement_um,)
        return SimpleNamespace(model=model, rms_percent=self.rms_percent, modelled_um=um)

    @property
    def held_out(self):
        if self.held_out_percent is None:
            return None
        return SimpleNamespace(judgement=SimpleNamespace(rms_percent=self.held_out_percent))


def identifying(*found):
    """Return what finds models one after the other, with the modes that it was given."""
    left = iter(found)
    return lambda modes: replace(next(left), modes=tuple(modes))


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
    stiffer = Structure(natural_hz=2200.0, damping_ratio=0.1)
    found = with_modes(
        [RECORD],
        identifying(Found(1.0, 1.0), Found(0.9, 0.5, first=stiffer), Found(0.1, 0.46)),
    )
    assert (found.modes, found.held_out_percent) == ((MODE,), 0.5)
    assert asked == [(0, 2000.0), (1, 2200.0)]


def test_a_mode_that_helps_only_what_was_fitted_is_left_out(asked):
    found = with_modes([RECORD], identifying(Found(1.0, 1.0), Found(0.1, WORTH)))
    assert (found.modes, found.held_out_percent) == ((), 1.0)


def test_without_data_held_out_the_fit_itself_judges(asked):
    found = with_modes([RECORD], identifying(Found(1.0), Found(0.5), Found(0.46)))
    assert (found.modes, found.rms_percent) == ((MODE,), 0.5)


def test_it_ends_after_some_turns(asked):
    found = with_modes([RECORD], identifying(*[Found(0.5**k) for k in range(20)]))
    assert len(found.modes) == TURNS == 4


def test_it_ends_where_no_mode_shows(monkeypatch):
    asked = []
    monkeypatch.setattr(subject, "further_modes", lambda *known: asked.append(known))
    assert with_modes([RECORD], identifying(Found(1.0))).modes == ()
    assert len(asked) == 1


def test_a_model_without_a_structure_has_no_first_mode(asked):
    with_modes([RECORD], identifying(Found(1.0, first=None), Found(1.0)))
    assert asked == [(0, None)]


@pytest.mark.parametrize(
    ("records", "settings"),
    [
        ([RECORD], FitSettings(kind="field", modes=False)),
        ([RECORD], FitSettings(kind="ppi")),
        ([RECORD, SteadyLoop("l", TIME, TIME, 10.0)], FIELD),
    ],
)
def test_nothing_is_looked_for_where_it_is_not_asked_for_or_can_not_be(records, settings, asked):
    assert with_modes(records, identifying(Found(1.0, settings=settings))).modes == ()
    assert not asked
