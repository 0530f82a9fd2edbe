"""The kind of model that does best on data held out: fitted to a part, judged on the rest."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from hilctl.base.device import CommandUnit
from hilctl.base.errors import DataError
from hilctl.identify.data.records import History, Record
from hilctl.identify.held_out import HeldOut, held_out_error
from hilctl.identify.job import OnProgress
from hilctl.identify.settings import IdentifySettings
from hilctl.identify.workers import Map

WHOLE: tuple[Mapping[str, Any], ...] = (
    {"kind": "field"},
    {"kind": "field", "drags": 0},
    {"kind": "generalised_duhem"},
    {"kind": "integrated", "offset": True},
)
"""What is tried on histories."""
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
    best: tuple[float, IdentifySettings, HeldOut] | None = None
    errors: list[CandidateError] = []
    for i, candidate in enumerate(candidates):
        tried = IdentifySettings(**{**candidate, **shared})
        name = ", ".join(f"{key} {value}" for key, value in candidate.items())
        progress(i / len(candidates), name)
        held_out = held_out_error(records, tried, unit, run, progress)
        if held_out is None:
            continue
        judged = held_out.judgement
        errors.append(CandidateError(name, judged.rms_percent, judged.peak_percent))
        if best is None or judged.rms_percent < best[0]:
            best = judged.rms_percent, tried, held_out
    if best is None:
        raise DataError("too few data to leave some out and choose by them: name a --model")
    return best[1], best[2], tuple(errors)
