"""The kind of model that does best on data held out: fitted to a part, judged on the rest."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from hilctl.base.device import CommandUnit
from hilctl.base.errors import DataError
from hilctl.identify.data.records import History, Record
from hilctl.identify.held_out import HeldOut, held_out_error
from hilctl.identify.job import OnProgress, ignore_progress
from hilctl.identify.settings import IdentifySettings
from hilctl.identify.workers import Map, one_by_one

WHOLE: tuple[Mapping[str, Any], ...] = (
    {"kind": "field", "drags": 0},
    {"kind": "generalised_duhem"},
    {"kind": "integrated", "offset": True},
)
"""What is tried on histories."""
THEN: Mapping[str, tuple[Mapping[str, Any], ...]] = {"field": ({"kind": "field"},)}
"""What is tried as well where a kind is the best of these: its small loops may creep."""
LOOPS: tuple[Mapping[str, Any], ...] = (
    {"kind": "staged"},
    {"kind": "integrated", "offset": True},
)
"""What is tried on steady loops."""


@dataclass(frozen=True, slots=True)
class CandidateError:
    """How a kind of model did on data that it was not fitted to.

    Attributes:
        settings: The kind, and what was not left as published.
        rms_percent: Of the largest peak-to-peak displacement.
        peak_percent: The same for the largest error.
    """

    settings: str
    rms_percent: float
    peak_percent: float


def choose_kind(
    records: Sequence[Record],
    settings: IdentifySettings,
    unit: CommandUnit,
    run: Map,
    progress: OnProgress,
) -> tuple[IdentifySettings, HeldOut, tuple[CandidateError, ...]]:
    """Fit each candidate to a part of the data, and take the one that does best on the rest.

    Args:
        records: The data.
        settings: How files were read; of the fit, nothing.
        unit: Unit of the command.
        run: Runs fits that do not depend on each other.
        progress: Called with what is being done.

    Returns:
        The choices of the best, how it did, and how each of them did.

    Raises:
        DataError: There are too few data to leave some out.
    """
    candidates = WHOLE if any(isinstance(record, History) for record in records) else LOOPS
    shared = {"whole": settings.whole, "table": settings.table, "points": settings.points}
    tried: list[tuple[IdentifySettings, HeldOut]] = []
    errors: list[CandidateError] = []
    while candidates:
        names = [", ".join(f"{key} {value}" for key, value in each.items()) for each in candidates]
        progress(len(errors) / (len(errors) + len(names)), "; ".join(names))
        trials = [
            _Trial(tuple(records), IdentifySettings(**{**each, **shared}), unit)
            for each in candidates
        ]
        for trial, name, held_out in zip(trials, names, run(_held_out, trials), strict=True):
            if held_out is not None:
                judged = held_out.judgement
                errors.append(CandidateError(name, judged.rms_percent, judged.peak_percent))
                tried.append((trial.settings, held_out))
        if not tried:
            raise DataError("too few data to leave some out and choose by them: name a --model")
        best = min(tried, key=lambda each: each[1].judgement.rms_percent)
        candidates = THEN.get(best[0].kind, ()) if candidates is WHOLE else ()
    return *best, tuple(errors)


@dataclass(frozen=True, slots=True)
class _Trial:
    records: tuple[Record, ...]
    settings: IdentifySettings
    unit: CommandUnit


def _held_out(trial: _Trial) -> HeldOut | None:
    return held_out_error(trial.records, trial.settings, trial.unit, one_by_one, ignore_progress)
