"""How a fit does on data that it has not seen: parts of the data are left out of it in turn."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from hilctl.base.errors import DataError
from hilctl.base.types import F64, CommandUnit
from hilctl.identify.data.records import History, Record, SteadyLoop
from hilctl.identify.evaluation import Evaluation, judge, judgement_of
from hilctl.identify.fit_api import OnProgress
from hilctl.identify.fit_data import FitData
from hilctl.identify.fit_kind import fit_kind
from hilctl.identify.parallel import MapFunction
from hilctl.identify.settings import FitSettings
from hilctl.models.linear_stages import FurtherMode

FEWEST_LOOPS = 4
FOLDS = 3
SEED = 1
HEAD = 0.7  # part of a history that is fitted, where the rest is held out
SAME = 0.02  # of a span: what counts as within it
MOVES = 0.1  # of a history's peak-to-peak: what its last part must move by, or it says nothing


@dataclass(frozen=True, slots=True)
class Split:
    """One fit for the sake of what it does not see.

    Attributes:
        fitted: The records that it sees.
        held_out: Those that it is judged on.
    """

    fitted: tuple[Record, ...]
    held_out: tuple[Record, ...]


@dataclass(frozen=True, slots=True)
class HeldOut:
    """How a model does on data that its fit did not see.

    Attributes:
        judgement: The errors.
        records: The data.
        how: Where they come from, for people.
        end: Where the last of the fits ended, for one to all the data to go on from.
    """

    judgement: Evaluation
    records: tuple[Record, ...]
    how: str
    end: object | None = None

    def to_mapping(self) -> dict[str, Any]:
        """Return the errors as plain mappings, lists and numbers, for JSON."""
        return self.judgement.to_mapping() | {"how": self.how}


@dataclass(frozen=True, slots=True)
class _Trial:
    fold: Split
    settings: FitSettings
    unit: CommandUnit
    start: object | None
    modes: Sequence[FurtherMode]


def folds_of(records: Sequence[Record]) -> list[Split]:
    """Return what is held out of which fit; none where there are too few data.

    What would narrow the range of commands, frequencies or speeds is not held out: beyond its
    range a model need not hold, and a run is warned. Of whole histories the last part is held out.
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


def held_out_error(
    records: Sequence[Record],
    settings: FitSettings,
    unit: CommandUnit,
    run: MapFunction,
    progress: OnProgress,
    start: object | None = None,
    modes: Sequence[FurtherMode] = (),
) -> HeldOut | None:
    """Fit with parts of the data left out, and judge on these; None where too few are left.

    Args:
        records: All data.
        settings: The choices of the fit; one start of its search is enough.
        unit: Unit of the command.
        run: Runs fits that do not depend on each other.
        progress: Called with what is being done.
        start: Where fits begin, see :class:`~hilctl.identify.fit_api.FitJob`.
        modes: Further modes of the structure, for kinds that have them.
    """
    lean = settings.model_copy(update={"starts": 1})
    trials = [_Trial(fold, lean, unit, start, modes) for fold in folds_of(records)]
    progress(0.0, f"{len(trials)} fits with data left out")
    done = [
        (trial.fold.held_out, *found)
        for trial, found in zip(trials, run(_tried, trials), strict=True)
        if found is not None
    ]
    if not done:
        return None
    held_out = tuple(record for out, _, _ in done for record in out)
    responses_um = np.concatenate([modelled for _, modelled, _ in done])
    parts = "the last parts of histories" if isinstance(held_out[-1], History) else "loops"
    how = f"{len(held_out)} of {len(records)} {parts}, left out of the fit in turn"
    judgement = judgement_of(FitData(held_out, unit), responses_um)
    return HeldOut(judgement, held_out, how, done[-1][2])


def _tried(trial: _Trial) -> tuple[F64, object | None] | None:
    """Return what a model gives of the data that it did not see, and where its search ended."""
    fitted, settings = trial.fold.fitted, trial.settings
    try:
        found = fit_kind(fitted, settings, trial.unit, start=trial.start, modes=trial.modes)
    except DataError:  # what is left is too little for this kind of fit; all of it need not be
        return None
    judged = judge(found.model, trial.fold.held_out, creep=settings.creep)
    return np.concatenate(judged.modelled_um), found.end


def _halved(record: Record) -> tuple[Record, Record | None]:
    """Return what is fitted of a record, and what is held out; nothing of a loop."""
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
    """Return what no record held out may exceed: command, frequency and speed, both ways."""
    command, rate, _ = record.run()
    frequency_hz = record.frequency_hz if isinstance(record, SteadyLoop) else 0.0
    speed = float(np.abs(rate).max())
    return np.array([command.max(), -command.min(), frequency_hz, -frequency_hz, speed])
