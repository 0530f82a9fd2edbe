"""The kind of model that does best on data held out: fitted to a part, judged on the rest."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import zip_longest
from typing import Any

from hilctl.base.errors import DataError
from hilctl.base.types import CommandUnit
from hilctl.identify.cross_validation import HeldOut, held_out_error
from hilctl.identify.data.records import History, Record
from hilctl.identify.fit_api import OnProgress, ignore_progress
from hilctl.identify.parallel import MapFunction, serial_map
from hilctl.identify.settings import IdentifySettings, kinds_of
from hilctl.models.linear_stages import FurtherMode

WHOLE: tuple[Mapping[str, Any], ...] = (
    {"kind": "field", "drags": 0, "plays": 8, "cells": 12, "knots": 16},
    {"kind": "generalised_duhem", "cells": 12, "across": 8},
)
"""What is tried on histories: of each kind a model small enough to be found soon."""
PLAIN: Mapping[str, Any] = {"kind": "integrated", "offset": True}
"""What is tried on them as well where none of these does well."""
WELL_PERCENT = 1.0  # rms of the stroke: small models of the right kind come to a third of it
IN_FULL: Mapping[str, tuple[Mapping[str, Any], ...]] = {
    "field": ({"kind": "field", "drags": 0}, {"kind": "field"}),
    "generalised_duhem": ({"kind": "generalised_duhem"},),
}
"""What is tried of a kind whose small model did well, one after the other: the small loops of a
field may creep."""
LONGEST = max(map(len, IN_FULL.values()))
NEAR = 2.0  # times the least error: that of a small model whose kind may still be the best
WORTH = 0.95  # of an error: what more operators must bring it to; each run takes longer by them
LOOPS: tuple[Mapping[str, Any], ...] = (
    {"kind": "staged"},
    {"kind": "integrated", "offset": True},
)
"""What is tried on steady loops."""


@dataclass(frozen=True, slots=True)
class CandidateScore:
    """How a kind of model did on data that it was not fitted to.

    Attributes:
        settings: The kind, and what was not left as published.
        rms_percent: Of the largest peak-to-peak displacement.
        peak_percent: The same for the largest error.
    """

    settings: str
    rms_percent: float
    peak_percent: float


@dataclass(frozen=True, slots=True)
class SelectedModel:
    """What a kind of model is chosen for.

    Attributes:
        records: The data.
        settings: How files were read, and which parts that may be left out are looked for; of the
            fit, nothing else.
        unit: Unit of the command.
        modes: Further modes of the structure that are known, for kinds that have them.
    """

    records: tuple[Record, ...]
    settings: IdentifySettings
    unit: CommandUnit
    modes: tuple[FurtherMode, ...] = ()


def choose_kind(
    choice: SelectedModel, run: MapFunction, progress: OnProgress
) -> tuple[IdentifySettings, HeldOut, tuple[CandidateScore, ...]]:
    """Fit each candidate to a part of the data, and take the one that does best on the rest.

    Of histories, small models say which kinds are worth a large one: the errors of the wrong kind
    are several times those of the right one at any size.

    Args:
        choice: The data, and what else all candidates share.
        run: Runs fits that do not depend on each other.
        progress: Called with what is being done.

    Returns:
        The choices of the best, how it did, and how each of them did.

    Raises:
        DataError: There are too few data to leave some out.
    """
    whole = any(isinstance(record, History) for record in choice.records)
    trials = _Trials(choice, run, progress)
    errors = trials.of(WHOLE if whole else LOOPS)
    if whole and not any(each.rms_percent < WELL_PERCENT for each in errors):
        errors += trials.of((PLAIN,))
    if not errors:
        raise DataError("too few data to leave some out and choose by them: name a --model")
    best = min(errors, key=_rms_percent)
    near = [each for each in errors if each.rms_percent <= NEAR * best.rms_percent]
    for turn in range(LONGEST if whole else 0):
        chains = [(IN_FULL.get(each.settings.kind, ())[turn:], each) for each in near]
        larger = [(chain[0], each) for chain, each in chains if chain]
        found = trials.of([more for more, _ in larger], [each.held_out.end for _, each in larger])
        errors += found
        best = min((best, *(x for x in found if x.rms_percent < WORTH * best.rms_percent)),
                   key=_rms_percent)  # fmt: skip
        near = [best] if best in found else []
    return best.settings, best.held_out, tuple(each.error for each in errors)


@dataclass(frozen=True, slots=True)
class _Tried:
    name: str
    settings: IdentifySettings
    held_out: HeldOut

    @property
    def rms_percent(self) -> float:
        return self.held_out.judgement.rms_percent

    @property
    def error(self) -> CandidateScore:
        return CandidateScore(self.name, self.rms_percent, self.held_out.judgement.peak_percent)


def _rms_percent(tried: _Tried) -> float:
    return tried.rms_percent


@dataclass(frozen=True, slots=True)
class _Trials:
    """Fits of candidates to a part of the records."""

    choice: SelectedModel
    run: MapFunction
    progress: OnProgress

    def of(
        self, candidates: Sequence[Mapping[str, Any]], starts: Sequence[object | None] = ()
    ) -> list[_Tried]:
        """Return how candidates do that can be fitted; searches begin where others ended."""
        given = self.choice.settings
        shared: dict[str, Any] = {
            "whole": given.whole,
            "table": given.table,
            "points": given.points,
        }
        trials = [
            _Trial(self.choice, IdentifySettings(**each, **shared, **_parts(each, given)), start)
            for each, start in zip_longest(candidates, starts)
        ]
        names = [", ".join(f"{key} {value}" for key, value in each.items()) for each in candidates]
        self.progress(0.0, "; ".join(names))
        found = zip(names, trials, self.run(_held_out, trials), strict=True)
        return [_Tried(name, trial.settings, out) for name, trial, out in found if out is not None]


def _parts(candidate: Mapping[str, Any], given: IdentifySettings) -> dict[str, Any]:
    """Return whether parts that may be left out are looked for, those that a kind has."""
    fields, kind = IdentifySettings.model_fields, candidate["kind"]
    has = [name for name in ("creep_stage", "modes") if kind in kinds_of(fields[name])]
    return {name: getattr(given, name) for name in has}


@dataclass(frozen=True, slots=True)
class _Trial:
    choice: SelectedModel
    settings: IdentifySettings
    start: object | None


def _held_out(trial: _Trial) -> HeldOut | None:
    choice, settings = trial.choice, trial.settings
    modes = choice.modes if settings.looks_for("modes") else ()
    return held_out_error(
        choice.records, settings, choice.unit, serial_map, ignore_progress, trial.start, modes
    )
