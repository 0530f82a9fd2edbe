"""Choose the kind of model and the lag of tables by errors on held-out data.

A kind is chosen by the geometric mean of its errors by stroke. Large motions dominate the rms error
of whole histories, which hides a kind whose small loops are several times worse.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import zip_longest
from typing import Any

import numpy as np

from hilctl.base.errors import DataError
from hilctl.base.types import F64
from hilctl.lab.identify.creep_spectrum import creeps
from hilctl.lab.identify.data.records import History, Record, Records, SteadyLoop, turning_points
from hilctl.lab.identify.evaluation import Evaluation, judgement_of, responses_um
from hilctl.lab.identify.fit_api import FitRequest, OnProgress, ignore_progress
from hilctl.lab.identify.fit_data import FitData
from hilctl.lab.identify.fit_model import fit_kind, fit_model
from hilctl.lab.identify.parallel import MapFunction
from hilctl.lab.identify.settings import FitSettings, IdentifySettings

FEWEST_LOOPS = 4
FOLDS = 3
SEED = 1
HEAD = 0.7  # part of a history that is fitted if the rest is held out
SAME = 0.02  # tolerance of a span, as a share of it
MOVES = 0.1  # least motion of a held-out last part, as a share of a history's peak-to-peak


@dataclass(frozen=True, slots=True)
class Split:
    """Records of one fit, and held-out ones that it is evaluated on."""

    fitted: tuple[Record, ...]
    held_out: tuple[Record, ...]


@dataclass(frozen=True, slots=True)
class HeldOut:
    """Errors on held-out data, whose origin is ``how``; a fit to all can start from ``end``."""

    judgement: Evaluation
    records: tuple[Record, ...]
    how: str
    end: object | None = None

    def to_mapping(self) -> dict[str, Any]:
        """Return the errors as plain mappings, lists and numbers, for JSON."""
        return self.judgement.to_mapping() | {"how": self.how}


def folds_of(records: Sequence[Record], validate: Sequence[Record] = ()) -> list[Split]:
    """Return the folds; none if there are too few data.

    Records that extend the range of commands, frequencies or speeds are not held out, since a model
    need not be valid beyond its range. Of histories the last part is held out, or each in turn if
    no last part is within the range of the rest. Otherwise ``validate`` is held out.
    """
    given = [Split(tuple(records), tuple(validate))] if validate else []
    if any(isinstance(record, History) for record in records):
        heads, tails = zip(*map(_halved, records), strict=True)
        held_out = tuple(tail for tail in tails if tail is not None)
        if held_out:
            return [Split(heads, held_out)]
        folds = [
            Split((*records[:i], *records[i + 1 :]), (record,)) for i, record in enumerate(records)
        ]
        inner = [each for each in folds if each.fitted and _within(each.held_out[0], each.fitted)]
        return inner or given
    if len(records) < FEWEST_LOOPS:
        return given
    divided = []
    # Every third of a grid in its own order would be all loops of one frequency.
    mixed = np.random.default_rng(SEED).permutation(len(records)).tolist()
    for first in range(FOLDS):
        members = sorted(mixed[first::FOLDS])
        rest = [record for i, record in enumerate(records) if i not in members]
        out = [records[i] for i in members if _within(records[i], rest)]
        fitted = tuple(r for r in records if not any(r is other for other in out))
        if out:
            divided.append(Split(fitted, tuple(out)))
    return divided or given


def held_out_error(request: FitRequest) -> HeldOut | None:
    """Return errors of a fit on held-out parts of its data; None if they are too few."""
    request.progress(0.0, "fits with held-out data")
    (found,) = held_out_errors([request], request.run)
    return found


def held_out_errors(requests: Sequence[FitRequest], run: MapFunction) -> list[HeldOut | None]:
    """Return the errors of one start of each fit on held-out data; None if too few are left."""
    tasks = [
        (number, fold, replace(
            request,
            records=fold.fitted,
            settings=request.settings.model_copy(update={"starts": 1}),
            run=map,
            progress=ignore_progress,
        ))
        for number, request in enumerate(requests)
        for fold in folds_of(request.records, request.validate)
    ]  # fmt: skip
    done: list[list[tuple[Split, F64, object | None]]] = [[] for _ in requests]
    for (number, fold, _), found in zip(tasks, run(_fitted, tasks), strict=True):
        if found is not None:
            done[number].append((fold, *found))
    return [_together(*each) for each in zip(requests, done, strict=True)]


def _fitted(task: tuple[int, Split, FitRequest]) -> tuple[F64, object | None] | None:
    """Return the response to the held-out data, and where the search ended."""
    _, fold, request = task
    try:
        found = fit_kind(request)
    except DataError:  # too few records for this kind of fit; all of them may be enough
        return None
    return responses_um(found.model, FitData(fold.held_out)), found.end


def _together(
    request: FitRequest, done: Sequence[tuple[Split, F64, object | None]]
) -> HeldOut | None:
    if not done:
        return None
    held_out = tuple(record for fold, _, _ in done for record in fold.held_out)
    modelled_um = np.concatenate([each for _, each, _ in done])
    parts = "histories (or their last parts)" if isinstance(held_out[-1], History) else "loops"
    how = f"{len(held_out)} of {len(request.records)} {parts}, held out in turn"
    stroke_um = FitData(request.records).stroke_um
    data, creep = FitData(held_out, request.unit), request.settings.creep
    highest_hz = request.settings.highest_hz
    judgement = judgement_of(data, modelled_um, stroke_um, creep=creep, highest_hz=highest_hz)
    if not judgement.classes:
        return None
    return HeldOut(judgement, held_out, how, done[-1][2])


def _halved(record: Record) -> tuple[Record, Record | None]:
    """Return the fitted and the held-out part of a record; no part of a loop is held out."""
    if isinstance(record, SteadyLoop):
        return record, None
    command, displacement_um, held = record.command, record.displacement_um, record.held
    cut = record.ignore + round(HEAD * (command.size - record.ignore))
    try:
        head = replace(
            record,
            command=command[:cut],
            displacement_um=displacement_um[:cut],
            held=held[held < cut],
        )
        tail = replace(record, ignore=cut)
    except DataError:
        return record, None
    moves = np.ptp(displacement_um[cut:]) > MOVES * np.ptp(displacement_um)
    return (head, tail) if moves and _within(record, [head]) else (record, None)


def _within(record: Record, others: Sequence[Record]) -> bool:
    reached = np.max([_extremes(other) for other in others], axis=0)
    return bool(np.all(_extremes(record) <= reached + SAME * np.abs(reached)))


def _extremes(record: Record) -> F64:
    """Return command, frequency and speed, both ways, that held-out records may not exceed."""
    command = record.command
    frequency_hz = record.frequency_hz if isinstance(record, SteadyLoop) else 0.0
    speed = float(np.abs(record.rate()).max())
    return np.array([command.max(), -command.min(), frequency_hz, -frequency_hz, speed])


ALIKE = 1.2  # ratio of amplitudes or frequencies that count as one


def alike_loops(records: Sequence[Record]) -> Iterator[str]:
    """Yield notes on loops of one frequency or amplitude (80 % of them)."""
    frequencies_hz, sizes = map(np.concatenate, zip(*map(_swings, records), strict=True))
    low, high = np.percentile((frequencies_hz, sizes), (10.0, 90.0), axis=1, method="nearest")
    if high[0] < ALIKE * low[0]:
        yield (
            f"all loops are at {np.median(frequencies_hz):.3g} Hz, so the influence of the rate is "
            "unknown: add loops at other frequencies"
        )
    if high[1] < ALIKE * low[1]:
        yield (
            "all loops have one amplitude, so smaller loops are unknown: add loops at other "
            "amplitudes"
        )


def _swings(record: Record) -> tuple[F64, F64]:
    """Return frequency and size of the swings of a command, from turn to turn: float64[n] each."""
    command = record.command
    if isinstance(record, SteadyLoop):
        return np.array([record.frequency_hz]), np.array([np.ptp(command)])
    turns = turning_points(command)
    times, moves = np.diff(turns), np.abs(np.diff(command[turns]))
    inner = slice(1, -1) if times.size > 2 else slice(None)  # the first and the last are cut
    return 0.5 * record.sample_rate_hz / times[inner], moves[inner]


PLAIN: Mapping[str, Any] = {
    "kind": "ppi", "plays": 25, "weights": "free", "layout": "midpoint", "offset": True,
}  # fmt: skip
"""The simplest candidate for all data: plays alone, fitted by linear least squares."""
WHOLE: tuple[Mapping[str, Any], ...] = (
    {"kind": "field", "plays": 8, "cells": 12, "knots": 16},
    {"kind": "generalised_duhem", "cells": 12, "across": 8},
)
"""Candidates for histories: a small model of each kind, which is identified quickly."""
CREEPING: Mapping[str, Any] = {**WHOLE[0], "activation": True}
"""Further candidate for histories whose rests show creep."""
ACCOMMODATING: Mapping[str, Any] = {**WHOLE[0], "accommodation": True}
"""Further candidate for histories if the error of all others is large."""
RIGID: Mapping[str, Any] = {**WHOLE[0], "structure": False, "modes": False}
"""Further candidate for histories of one amplitude or frequency, if no structure was measured."""
INTEGRATED: Mapping[str, Any] = {"kind": "integrated", "offset": True}
"""The same."""
WELL_PERCENT = 0.6  # mean error by stroke that small models of the right kind reach
IN_FULL = {"field", "generalised_duhem"}
"""Kinds with a larger candidate, of their default size, if their small model has a small error."""
NEAR = 2.0  # largest error of a small model of the best kind, over the least error
WORTH = 0.95  # of the error of a simpler model: the largest one of a model with more parts
CLEAR = 0.5  # the same on data of one amplitude or frequency, which show no other motions
LOOPS: tuple[Mapping[str, Any], ...] = ({"kind": "staged"}, INTEGRATED)
"""Candidates for steady loops."""
MOST_LAG = 8  # samples tried


@dataclass(frozen=True, slots=True)
class CandidateScore:
    """Errors of one kind of model on held-out data, in percent of the largest stroke."""

    settings: str
    rms_percent: float
    peak_percent: float
    stroke_percent: float  # that kinds are compared by, in percent of the motions' own peak-to-peak


@dataclass(frozen=True, slots=True)
class Selection:
    """Selected settings, their errors on held-out data, and those of everything tried."""

    settings: FitSettings
    held_out: HeldOut | None = None
    candidates: tuple[CandidateScore, ...] = ()


def select(request: FitRequest) -> Selection:
    """Select the kind, if it is open, by held-out errors; raise DataError if data are too few."""
    settings = request.settings
    if isinstance(settings, IdentifySettings) and settings.auto:
        return _choose_kind(request, settings)
    return Selection(settings)


def _choose_kind(request: FitRequest, given: IdentifySettings) -> Selection:
    """Return the kind with the least error."""
    # Small models select the kinds to try at full size: a wrong kind is far off at any size.
    whole = any(isinstance(record, History) for record in request.records)
    candidates = [PLAIN, *(WHOLE if whole else LOOPS)]
    alike = any(alike_loops(request.records))
    if whole and alike and given.structure and request.structure is None:
        candidates.insert(1, RIGID)
    if whole and given.creep_stage and creeps(request.records):
        candidates.append(CREEPING)
    errors = _candidates(request, given, candidates)
    if whole and not any(each.stroke_percent < WELL_PERCENT for each in errors):
        errors += _candidates(request, given, (INTEGRATED, ACCOMMODATING))
    if not errors:
        raise DataError(f"too few data to select a kind of model: {_undivided(request.records)}")
    worth = CLEAR if alike else WORTH
    best = _simplest(errors, worth)
    most = NEAR * min(each.stroke_percent for each in errors)
    near = [x for x in errors if x.settings.kind in IN_FULL and x.stroke_percent <= most]
    if near:
        larger = [_in_full(each) for each in near]
        found = _candidates(request, given, larger, [each.held_out.end for each in near])
        errors += found
        worth = WORTH if best in near else worth
        best = _simplest([best, *sorted(found, key=lambda tried: tried.stroke_percent)], worth)
    return Selection(best.settings, best.held_out, candidates=tuple(e.candidate for e in errors))


def _simplest(errors: "Sequence[_Tried]", worth: float) -> "_Tried":
    """Return the first, simplest one that none of the others is worth more than."""
    least = min(each.stroke_percent for each in errors)
    return next(each for each in errors if worth * each.stroke_percent <= least)


def _undivided(records: Sequence[Record]) -> str:
    """Return why nothing was held out, with a remedy."""
    record = records[0]
    if not isinstance(record, History):
        return (
            f"{len(records)} steady loops, at least {FEWEST_LOOPS} are needed. Add loops at other "
            "amplitudes and frequencies, or set --model staged"
        )
    cut_s = record.time_s[record.ignore + round(HEAD * (record.command.size - record.ignore))]
    return (
        f"from {cut_s:.4g} s, '{record.label}' moves further or faster than before, or hardly. "
        "Add a file of other motions with --validate, or use hilctl identify --model field"
    )


def _in_full(tried: "_Tried") -> dict[str, Any]:
    """Return the settings of a model of the same kind and parts in its default size."""
    settings = tried.settings
    chosen: dict[str, Any] = {"kind": settings.kind}
    if settings.looks_for("activation"):
        # Each of the plays that creep costs as much per sample as eight that do not.
        chosen |= {"activation": True, "plays": 16}
    if settings.looks_for("accommodation"):
        chosen |= {"accommodation": True}
    if not settings.looks_for("structure"):
        chosen |= {"structure": False, "modes": False}
    return chosen


@dataclass(frozen=True, slots=True)
class _Tried:
    name: str
    settings: FitSettings
    held_out: HeldOut

    @property
    def stroke_percent(self) -> float:
        return self.held_out.judgement.stroke_percent

    @property
    def candidate(self) -> CandidateScore:
        judged = self.held_out.judgement
        return CandidateScore(
            self.name, judged.rms_percent, judged.peak_percent, judged.stroke_percent
        )


def _tried(
    request: FitRequest,
    named: Sequence[tuple[str, FitSettings]],
    starts: Sequence[object | None] = (),
) -> list[_Tried]:
    """Return the errors of settings that can be fitted; searches begin where others ended."""
    requests = [
        replace(request, settings=settings, start=start)
        for (_, settings), start in zip_longest(named, starts)
    ]
    found = zip(named, held_out_errors(requests, request.run), strict=True)
    return [_Tried(name, settings, out) for (name, settings), out in found if out is not None]


def _candidates(
    request: FitRequest,
    given: IdentifySettings,
    candidates: Sequence[Mapping[str, Any]],
    starts: Sequence[object | None] = (),
) -> list[_Tried]:
    shared = {name: getattr(given, name) for name in ("whole", "table", "points", "highest_hz")}
    names = [", ".join(f"{key} {value}" for key, value in each.items()) for each in candidates]
    request.progress(0.0, "; ".join(names))
    settings = [IdentifySettings(**each, **shared) for each in candidates]
    parts = {name: getattr(given, name) for name in ("creep_stage", "modes", "structure")}
    settings = [
        each.model_copy(update={k: on for k, on in parts.items() if each.has(k) and k not in own})
        for each, own in zip(settings, candidates, strict=True)
    ]
    return _tried(request, list(zip(names, settings, strict=True)), starts)


def choose_lag(
    load: Callable[[int], Records], settings: FitSettings, run: MapFunction, progress: OnProgress
) -> int:
    """Return the lag with the least error; ``load`` returns data shifted by that many samples."""
    progress(0.0, f"{MOST_LAG + 1} fits for the lag of the displacement")
    lean = settings.model_copy(update={"starts": 1})
    requests = [FitRequest(tuple(load(lag)), lean) for lag in range(MOST_LAG + 1)]
    return int(np.argmin(list(run(_rms_um, requests))))


def _rms_um(request: FitRequest) -> float:
    fit = fit_model(request)
    return fit.rms_percent * max(error.peak_to_peak_um for error in fit.errors)
