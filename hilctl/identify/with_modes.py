"""Further modes of the structure, for as long as a model does better by them on data held out."""

from collections.abc import Callable, Sequence
from typing import Protocol, TypeVar

from hilctl.identify.data.records import History, Record
from hilctl.identify.fit_model import FittedModel
from hilctl.identify.held_out import HeldOut
from hilctl.identify.modes import WORTH, further_modes
from hilctl.identify.settings import FitSettings
from hilctl.models.structure import Mode, Structure

TURNS = 4  # each finds a model anew


class Judged(Protocol):
    """A model, and how it does on data that its fit did not see."""

    @property
    def fit(self) -> FittedModel:
        """The model."""

    @property
    def held_out(self) -> HeldOut | None:
        """How it does on such data; None where there were none."""

    @property
    def settings(self) -> FitSettings:
        """How it was fitted."""


_Judged = TypeVar("_Judged", bound=Judged)


def with_modes(records: Sequence[Record], identify: Callable[[Sequence[Mode]], _Judged]) -> _Judged:
    """Return a model with the further modes that its records show.

    A mode that was left out bends all the rest, so the model is found anew without it each time,
    and what it leaves shows the modes the better.

    Args:
        records: What it is fitted to.
        identify: Finds a model of them, given modes that are known.
    """
    best = identify(())
    histories = [record for record in records if isinstance(record, History)]
    if not best.settings.looks_for("modes") or len(histories) < len(records):
        return best
    for _ in range(TURNS):
        model = best.fit.model
        structure, known = getattr(model, "structure", None), getattr(model, "modes", ())
        first_hz = structure.natural_hz if isinstance(structure, Structure) else None
        better = further_modes(histories, best.fit.modelled_um, known, first_hz)
        if better is None:
            break
        tried = identify(better)
        if not _rms_percent(tried) < WORTH * _rms_percent(best):
            break
        best = tried
    return best


def _rms_percent(judged: Judged) -> float:
    """Return the error on data held out; on all data where none were."""
    if judged.held_out is None:
        return judged.fit.rms_percent
    return judged.held_out.judgement.rms_percent
