"""The kind that does best on data held out is taken."""

from typing import Any

import numpy as np
import pytest

from hilctl.base.errors import DataError
from hilctl.identify import model_selection
from hilctl.identify.command import settings_from
from hilctl.identify.cross_validation import HeldOut
from hilctl.identify.data.records import History, Record, SteadyLoop
from hilctl.identify.evaluation import Evaluation
from hilctl.identify.fit_api import ignore_progress
from hilctl.identify.model_selection import LOOPS, SelectedModel, choose_kind
from hilctl.identify.parallel import serial_map
from hilctl.models.linear_stages import FurtherMode

WAVE = np.sin(np.linspace(0.0, 6.0, 64))
HISTORY = History("history", WAVE, 9.0 * WAVE, 100.0)
LOOP = SteadyLoop("loop", WAVE, 9.0 * WAVE, 1.0)
MODE = FurtherMode(
    natural_hz=20.0, damping_ratio=0.1, antiresonance_hz=18.0, antiresonance_damping_ratio=0.1
)


SMALL = {"field 0 8": 0.6, "generalised_duhem 12": 0.9, "field 0 32": 0.3, "field 3 32": 0.2}


def fake(monkeypatch: pytest.MonkeyPatch, errors: dict[str, float | None]) -> list[tuple[str, Any]]:
    """Let fits have errors by kind, drags and size; return the list of them and their starts."""
    seen: list[tuple[str, Any]] = []

    def held_out_error(records: Any, settings: Any, *rest: Any) -> HeldOut | None:
        name = {
            "field": f"field {settings.drags} {settings.plays}",
            "generalised_duhem": f"generalised_duhem {settings.cells}",
        }.get(settings.kind, settings.kind)
        seen.append((name, rest[-2]))
        rms = errors[name]
        if rms is None:
            return None
        judgement = Evaluation(
            errors=(), modelled_um=(), peak_percent=3.0 * rms, rms_percent=rms, own_peak_percent=0.0
        )
        return HeldOut(judgement, tuple(records), "test", f"end of {name}")

    monkeypatch.setattr(model_selection, "held_out_error", held_out_error)
    return seen


def chosen(records: list[Record]) -> Any:
    choice = SelectedModel(tuple(records), settings_from("auto", []), "A")
    return choose_kind(choice, serial_map, ignore_progress)


def test_the_kind_whose_small_model_does_well_is_tried_in_full(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    seen = fake(monkeypatch, {**SMALL, "generalised_duhem 12": 1.3})
    settings, held_out, errors = chosen([HISTORY])
    assert (settings.kind, settings.drags, settings.whole) == ("field", 3, True)
    assert held_out.judgement.rms_percent == 0.2
    assert [error.rms_percent for error in errors] == [0.6, 1.3, 0.3, 0.2]
    # Each goes on from where the one before it ended, and the fit to all data from the last.
    starts = [start for _, start in seen]
    assert starts == [None, None, "end of field 0 8", "end of field 0 32"]
    assert held_out.end == "end of field 3 32"


def test_more_operators_are_taken_only_where_they_are_worth_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    fake(monkeypatch, {**SMALL, "generalised_duhem 12": 1.3, "field 3 32": 0.99 * 0.3})
    settings, _, _ = chosen([HISTORY])
    assert (settings.kind, settings.drags) == ("field", 0)


def test_a_kind_that_is_near_is_tried_in_full_as_well(monkeypatch: pytest.MonkeyPatch) -> None:
    fake(monkeypatch, {**SMALL, "generalised_duhem 28": 0.25})
    settings, _, errors = chosen([HISTORY])
    assert settings.kind == "generalised_duhem"
    assert [error.rms_percent for error in errors] == [0.6, 0.9, 0.3, 0.25]


@pytest.mark.parametrize("plain", [0.8, 5.0])
def test_a_plain_kind_is_tried_where_no_other_does_well(
    plain: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    poor = {"field 0 8": 2.0, "generalised_duhem 12": 1.9, "field 0 32": 1.8, "field 3 32": 1.8}
    fake(monkeypatch, {**poor, "generalised_duhem 28": 1.7, "integrated": plain})
    settings, _, _ = chosen([HISTORY])
    assert settings.kind == ("integrated" if plain < 1.0 else "generalised_duhem")


def test_loops_have_candidates_of_their_own(monkeypatch: pytest.MonkeyPatch) -> None:
    fake(monkeypatch, {"staged": 0.1, "integrated": None})
    settings, _, errors = chosen([LOOP])
    assert settings.kind == "staged"
    assert len(errors) == len(LOOPS) - 1


def test_without_anything_held_out_there_is_no_choice(monkeypatch: pytest.MonkeyPatch) -> None:
    fake(monkeypatch, dict.fromkeys(("field 0 8", "generalised_duhem 12", "integrated")))
    with pytest.raises(DataError, match="name a --model"):
        chosen([HISTORY])


@pytest.mark.parametrize("looked_for", [True, False])
def test_known_modes_are_for_kinds_that_look_for_them(
    monkeypatch: pytest.MonkeyPatch, looked_for: bool
) -> None:
    given: list[tuple[str, bool, tuple[FurtherMode, ...]]] = []

    def held_out_error(records: Any, settings: Any, *rest: Any) -> HeldOut | None:
        given.append((settings.kind, settings.creep_stage, rest[-1]))
        return None

    monkeypatch.setattr(model_selection, "held_out_error", held_out_error)
    texts = [f"modes={looked_for}".lower(), "creep_stage=false"]
    choice = SelectedModel((HISTORY,), settings_from("auto", texts), "A", (MODE,))
    with pytest.raises(DataError, match="too few data"):
        choose_kind(choice, serial_map, ignore_progress)
    known = (MODE,) if looked_for else ()
    assert given == [
        ("field", False, known),
        ("generalised_duhem", False, known),
        ("integrated", True, ()),
    ]
