"""The kind that does best on data held out is taken."""

from typing import Any

import numpy as np
import pytest

from hilctl.base.errors import DataError
from hilctl.identify import candidates
from hilctl.identify.candidates import LOOPS, WHOLE, choose_kind
from hilctl.identify.command import settings_from
from hilctl.identify.data.records import History, Record, SteadyLoop
from hilctl.identify.held_out import HeldOut
from hilctl.identify.job import ignore_progress
from hilctl.identify.judge import Judgement
from hilctl.identify.workers import one_by_one

WAVE = np.sin(np.linspace(0.0, 6.0, 64))
HISTORY = History("history", WAVE, 9.0 * WAVE, 100.0)
LOOP = SteadyLoop("loop", WAVE, 9.0 * WAVE, 1.0)


def fake(monkeypatch: pytest.MonkeyPatch, errors: dict[str, float | None]) -> None:
    def held_out_error(records: Any, settings: Any, *_: Any) -> HeldOut | None:
        rms = errors[settings.kind if settings.kind != "field" else f"field {settings.drags}"]
        if rms is None:
            return None
        return HeldOut(
            Judgement(errors=(), modelled_um=(), peak_percent=3.0 * rms, rms_percent=rms,
                      own_peak_percent=0.0), tuple(records), "test",
        )  # fmt: skip

    monkeypatch.setattr(candidates, "held_out_error", held_out_error)


def chosen(records: list[Record]) -> Any:
    return choose_kind(records, settings_from("auto", []), "A", one_by_one, ignore_progress)


def test_the_least_error_wins_and_all_are_told(monkeypatch: pytest.MonkeyPatch) -> None:
    fake(monkeypatch, {"field 3": 0.5, "field 0": 0.3, "generalised_duhem": 0.4, "integrated": 0.9})
    settings, held_out, errors = chosen([HISTORY])
    assert (settings.kind, settings.drags, settings.whole) == ("field", 0, True)
    assert held_out.judgement.rms_percent == 0.3
    assert [error.rms_percent for error in errors] == [0.3, 0.4, 0.9, 0.5]
    assert len(errors) == len(WHOLE) + 1


def test_drags_are_not_tried_where_plays_alone_are_not_the_best(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    fake(monkeypatch, {"field 0": 0.3, "generalised_duhem": 0.2, "integrated": 0.9})
    settings, _, errors = chosen([HISTORY])
    assert settings.kind == "generalised_duhem"
    assert [error.rms_percent for error in errors] == [0.3, 0.2, 0.9]


def test_loops_have_candidates_of_their_own(monkeypatch: pytest.MonkeyPatch) -> None:
    fake(monkeypatch, {"field 3": 0.5, "staged": 0.1, "integrated": None})
    settings, _, errors = chosen([LOOP])
    assert settings.kind == "staged"
    assert len(errors) == len(LOOPS) - 1


def test_without_anything_held_out_there_is_no_choice(monkeypatch: pytest.MonkeyPatch) -> None:
    fake(monkeypatch, dict.fromkeys(("field 3", "field 0", "generalised_duhem", "integrated")))
    with pytest.raises(DataError, match="name a --model"):
        chosen([HISTORY])
