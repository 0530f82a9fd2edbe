"""Errors of a fit on held-out data: parts of the data are left out of fits in turn."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from hilctl.base.errors import DataError
from hilctl.base.types import F64
from hilctl.identify.data.records import History, Record, SteadyLoop
from hilctl.identify.evaluation import Evaluation, judge, judgement_of
from hilctl.identify.fit_api import FitRequest, ignore_progress
from hilctl.identify.fit_data import FitData
from hilctl.identify.fit_model import fit_kind
from hilctl.identify.parallel import MapFunction, serial_map

FEWEST_LOOPS = 4
FOLDS = 3
SEED = 1
HEAD = 0.7  # part of a history that is fitted if the rest is held out
SAME = 0.02  # of a span: what counts as within it
MOVES = 0.1  # of a history's peak-to-peak: least motion of a last part that is held out


@dataclass(frozen=True, slots=True)
class Split:
    """Records of one fit, and those that it is evaluated on.

    Attributes:
        fitted: Fitted records.
        held_out: Held-out records.
    """

    fitted: tuple[Record, ...]
    held_out: tuple[Record, ...]


@dataclass(frozen=True, slots=True)
class HeldOut:
    """Errors of a model on held-out data.

    Attributes:
        judgement: The errors.
        records: The data.
        how: Origin of the data, as text.
        end: End of the last fit, from which a fit to all data can start.
    """

    judgement: Evaluation
    records: tuple[Record, ...]
    how: str
    end: object | None = None

    def to_mapping(self) -> dict[str, Any]:
        """Return the errors as plain mappings, lists and numbers, for JSON."""
        return self.judgement.to_mapping() | {"how": self.how}


def folds_of(records: Sequence[Record]) -> list[Split]:
    """Return the folds; none if there are too few data.

    Records that extend the range of commands, frequencies or speeds are not held out: a model need
    not be valid beyond its range, and a run warns there. Of histories the last part is held out.
    """
    if any(isinstance(record, History) for record in records):
        heads, tails = zip(*map(_halved, records), strict=True)
        held_out = tuple(tail for tail in tails if tail is not None)
        return [Split(heads, held_out)] if held_out else []
    if len(records) < FEWEST_LOOPS:
        return []
    folds = []
    # Every third of a grid in its own order would be all loops of one frequency.
    mixed = np.random.default_rng(SEED).permutation(len(records)).tolist()
    for first in range(FOLDS):
        members = sorted(mixed[first::FOLDS])
        rest = [record for i, record in enumerate(records) if i not in members]
        out = [records[i] for i in members if _within(records[i], rest)]
        fitted = tuple(r for r in records if not any(r is other for other in out))
        if out:
            folds.append(Split(fitted, tuple(out)))
    return folds


def held_out_error(request: FitRequest) -> HeldOut | None:
    """Fit with parts of the data left out, and evaluate on these; None if too few are left."""
    request.progress(0.0, "fits with data left out")
    (found,) = held_out_errors([request], request.run)
    return found


def held_out_errors(requests: Sequence[FitRequest], run: MapFunction) -> list[HeldOut | None]:
    """Fit each request with parts of its data left out, and evaluate on these.

    One start of each search is enough.

    Args:
        requests: What to fit.
        run: Runs the fits, which do not depend on each other.

    Returns:
        For each request its errors; None if too few data are left.
    """
    tasks = [
        _Task(number, fold, replace(
            request,
            records=fold.fitted,
            settings=request.settings.model_copy(update={"starts": 1}),
            run=serial_map,
            progress=ignore_progress,
        ))
        for number, request in enumerate(requests)
        for fold in folds_of(request.records)
    ]  # fmt: skip
    done: list[list[tuple[Split, F64, object | None]]] = [[] for _ in requests]
    for task, found in zip(tasks, run(_fitted, tasks), strict=True):
        if found is not None:
            done[task.number].append((task.fold, *found))
    return [_together(*each) for each in zip(requests, done, strict=True)]


@dataclass(frozen=True, slots=True)
class _Task:
    """One fit of the request of that number, to the fitted records of a fold."""

    number: int
    fold: Split
    request: FitRequest


def _fitted(task: _Task) -> tuple[F64, object | None] | None:
    """Return the response to the held-out data, and where the search ended."""
    try:
        found = fit_kind(task.request)
    except DataError:  # too few records for this kind of fit; all of them may be enough
        return None
    judged = judge(found.model, task.fold.held_out, creep=task.request.settings.creep)
    return np.concatenate(judged.modelled_um), found.end


def _together(
    request: FitRequest, done: Sequence[tuple[Split, F64, object | None]]
) -> HeldOut | None:
    if not done:
        return None
    held_out = tuple(record for fold, _, _ in done for record in fold.held_out)
    responses_um = np.concatenate([modelled for _, modelled, _ in done])
    parts = "the last parts of histories" if isinstance(held_out[-1], History) else "loops"
    how = f"{len(held_out)} of {len(request.records)} {parts}, left out of the fit in turn"
    judgement = judgement_of(FitData(held_out, request.unit), responses_um)
    return HeldOut(judgement, held_out, how, done[-1][2])


def _halved(record: Record) -> tuple[Record, Record | None]:
    """Return the fitted and the held-out part of a record; no part of a loop is held out."""
    if isinstance(record, SteadyLoop):
        return record, None
    label, rate_hz = record.label, record.sample_rate_hz
    command, displacement_um = record.command, record.displacement_um
    cut = record.ignore + round(HEAD * (command.size - record.ignore))
    try:
        head = History(label, command[:cut], displacement_um[:cut], rate_hz, record.ignore)
        tail = History(label, command, displacement_um, rate_hz, cut)
    except DataError:
        return record, None
    moves = np.ptp(displacement_um[cut:]) > MOVES * np.ptp(displacement_um)
    return (head, tail) if moves and _within(record, [head]) else (record, None)


def _within(record: Record, others: Sequence[Record]) -> bool:
    reached = np.max([_extremes(other) for other in others], axis=0)
    return bool(np.all(_extremes(record) <= reached + SAME * np.abs(reached)))


def _extremes(record: Record) -> F64:
    """Return command, frequency and speed, both ways, that held-out records may not exceed."""
    command, rate, _ = record.run()
    frequency_hz = record.frequency_hz if isinstance(record, SteadyLoop) else 0.0
    speed = float(np.abs(rate).max())
    return np.array([command.max(), -command.min(), frequency_hz, -frequency_hz, speed])
