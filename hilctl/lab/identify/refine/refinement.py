"""Refinement of a model by recordings: a better model, or reasons why there is none.

Held-out runs select the regularisation towards the old model.
"""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from hilctl.base.errors import DataError, InputError
from hilctl.base.formatting import shown_briefly
from hilctl.base.samples import Flag
from hilctl.lab.identify.data.data_faults import data_reasons
from hilctl.lab.identify.data.data_files import history_from_pieces
from hilctl.lab.identify.data.records import History
from hilctl.lab.identify.evaluation import judgement_of
from hilctl.lab.identify.fit_api import OnProgress, ignore_progress
from hilctl.lab.identify.fit_data import FitData
from hilctl.lab.identify.fit_model import VERSIONS, error_table, identified_range
from hilctl.lab.identify.model_selection import HeldOut, folds_of
from hilctl.lab.identify.refine.acceptance import (
    TOLERANCE_PERCENT,
    AcceptanceRule,
    ErrorChange,
    error_changes,
    error_ratio,
    worst_class,
)
from hilctl.lab.identify.refine.residual_fit import ResidualFit
from hilctl.models.base import HysteresisModel, IdentifiedRange, Provenance
from hilctl.models.refined import RefinedModel
from hilctl.recording.reader import read
from hilctl.recording.recording import Recording

STRENGTHS = (0.003, 0.01, 0.02, 0.03, 0.05, 0.1, 0.3, 1.0)
ANCHORS = (100.0, 10.0, 3.0)
"""Weights of the old model on motions of its whole range, of the least weight."""
AS_GOOD = 1.02  # of the least error on held-out runs
STRETCHES = 10  # parts of a run that are evaluated separately
MOST = 1.12  # maximum error of a part, of the old one
LARGE_GAIN = 0.5  # error after over error before
FOREGONE = 0.5  # part of the possible gain that even errors may cost


@dataclass(frozen=True, slots=True)
class RegularisationSplit:
    """Fitted and evaluated runs, by their numbers."""

    fitted: tuple[int, ...]
    judged: tuple[int, ...]


@dataclass(frozen=True, slots=True)
class SelectedRegularisation:
    """A regularisation, perhaps with each run's ``own`` drift, and its held-out errors."""

    strength: float
    anchor: float
    own: bool
    before: HeldOut
    after: HeldOut
    rule: AcceptanceRule

    @property
    def runs(self) -> tuple[ErrorChange, ...]:
        """Errors of held-out runs before and after."""
        return error_changes(self.before.judgement.errors, self.after.judgement.errors)

    @property
    def classes(self) -> list[ErrorChange]:
        """Errors of classes of held-out runs before and after."""
        return self.rule.classes(self.runs)

    @property
    def reasons(self) -> list[str]:
        """Why the old model is kept; empty if the refined one is better."""
        return self.rule.reasons(self.runs)

    @property
    def even(self) -> bool:
        """Whether no part of a run is much worse, such as its small motions."""
        worst = 1.0
        sides = zip(
            self.before.judgement.modelled_um, self.after.judgement.modelled_um, strict=True
        )
        for run, modelled in zip(self.after.records, sides, strict=True):
            assert isinstance(run, History)
            seen_um = run.displacement_um[run.ignore :]
            was, now = (
                [float(np.mean(part**2)) for part in np.array_split(side - seen_um, STRETCHES)]
                for side in modelled
            )
            ratios = [b / a for a, b in zip(was, now, strict=True) if a > 0.0]
            worst = max(worst, *ratios)
        return worst <= MOST**2

    @property
    def ratio(self) -> float:
        """Error of held-out runs after, over that before."""
        return error_ratio(self.runs)

    @property
    def better(self) -> bool:
        """Whether it is better than the old model."""
        return not self.reasons

    def as_good(self, other: "SelectedRegularisation") -> bool:
        """Return whether it is about as good as another one."""
        fair = self.better >= other.better and self.even >= other.even
        return fair and self.ratio <= AS_GOOD * other.ratio


def parts_of(
    runs: Sequence[History], validate: Sequence[History]
) -> tuple[tuple[History, ...], tuple[RegularisationSplit, ...]]:
    """Return the parts to fit or evaluate, and their splits; raise DataError if too few."""
    # Of several runs each is held out once; of one, its last part.
    every = tuple(range(len(runs)))
    if validate:
        others = tuple(range(len(runs), len(runs) + len(validate)))
        return (*runs, *validate), (RegularisationSplit(every, others),)
    if len(runs) > 1:
        return tuple(runs), tuple(
            RegularisationSplit((*every[:i], *every[i + 1 :]), (i,)) for i in every
        )
    folds = folds_of(runs)
    if not folds:
        raise DataError(f"{runs[0].label}: too short to hold out a part: add more recordings")
    head, tail = folds[0].fitted[0], folds[0].held_out[0]
    assert isinstance(head, History)
    assert isinstance(tail, History)
    return (head, tail), (RegularisationSplit((0,), (1,)),)


class Regularisation:
    """Refinements of a model with any regularisation."""

    def __init__(
        self,
        model: HysteresisModel,
        parts: Sequence[History],
        splits: Sequence[RegularisationSplit],
        rule: AcceptanceRule,
    ) -> None:
        self._parts, self._splits, self._unit = parts, splits, model.input_unit
        self._rule, self._model = rule, model
        # All fitted parts; also the end of a single run that is cut in two.
        fitted = {i for split in splits for i in split.fitted}
        cut = parts[-1].label == parts[0].label
        self._whole = tuple(range(len(parts))) if cut else tuple(sorted(fitted))
        self._remainder = ResidualFit(model, parts, [parts[i] for i in sorted(fitted)])
        self._anchor = self._remainder.anchor()
        self._moments = {own: self._remainder.moments(own=own) for own in (False, True)}
        old = dict.fromkeys(splits, model)
        self._before = {own: self._held_out(old, own=own) for own in (False, True)}

    def best(self, progress: OnProgress) -> tuple[SelectedRegularisation, RefinedModel]:
        """Return the best regularisation, perhaps worse than the old model, and its model."""
        found: list[tuple[SelectedRegularisation, RefinedModel, float]] = []
        ways = [(strength, own) for own in (False, True) for strength in STRENGTHS]
        for i, (strength, own) in enumerate(ways):
            progress(i / len(ways), f"strength {strength:g}")
            found.append(self._tried(strength, 1.0, own=own))
        # An offset per run may hide hysteresis, so it is used only if it lowers the total error of
        # held-out runs.
        own = min(found, key=lambda each: each[2])[0].own
        left = [(choice, whole) for choice, whole, _ in found if choice.own == own]
        best = min(left, key=lambda way: (not way[0].better, way[0].ratio))
        least_gain = FOREGONE * (1.0 - best[0].ratio)
        even = [way for way in left if way[0].even and way[0].better]
        even = [way for way in even if 1.0 - way[0].ratio >= least_gain]
        best = min(even, key=lambda way: way[0].ratio, default=best)
        # Beyond the motions of the runs the old model is kept, if that costs almost nothing. That
        # can also keep single runs from getting worse.
        strengths = [best[0].strength] if best[0].better else STRENGTHS
        held = [self._tried(s, a, own=own)[:2] for s in strengths for a in ANCHORS]
        least = min([best, *held], key=lambda way: (not way[0].better, way[0].ratio))
        if not best[0].better:
            return least
        good = (way for way in held if way[0].as_good(best[0]) and way[0].as_good(least[0]))
        return next(good, best)

    def fitted_ratio(self, refined: RefinedModel, *, own: bool) -> float:
        """Return the error of a model of all runs on these runs, over that of the old model."""
        split = RegularisationSplit(self._whole, self._whole)
        before, after = (
            self._held_out({split: model}, own=own).judgement.errors
            for model in (self._model, refined)
        )
        return error_ratio(error_changes(before, after))

    def _tried(
        self, strength: float, anchor: float, *, own: bool
    ) -> tuple[SelectedRegularisation, RefinedModel, float]:
        """Return a regularisation, its model of all runs, and its error on held-out runs."""
        models = {s: self._refined(s.fitted, strength, anchor, own=own) for s in self._splits}
        after = self._held_out(models)
        bare = self._held_out(models, own=True) if own else after
        choice = SelectedRegularisation(strength, anchor, own, self._before[own], bare, self._rule)
        whole = self._refined(self._whole, strength, anchor, own=own)
        return choice, whole, after.judgement.rms_percent

    def _refined(
        self, fitted: Sequence[int], strength: float, anchor: float, *, own: bool
    ) -> RefinedModel:
        sums = self._anchor.scaled(anchor)
        for i in fitted:
            sums += self._moments[own][i]
        # The penalty is on the residual operator; the anchor contains the old one.
        firm = self._remainder.firm(strength, sums)
        numbers = np.linalg.solve(sums.normal + firm, sums.right)
        return self._remainder.model(np.asarray(numbers, dtype=np.float64))

    def _held_out(
        self, models: Mapping[RegularisationSplit, HysteresisModel], *, own: bool = False
    ) -> HeldOut:
        judged = [(i, model) for split, model in models.items() for i in split.judged]
        records = tuple(self._parts[i] for i, _ in judged)
        modelled = [self._remainder.modelled_um(model, i) for i, model in judged]
        bare = [m[record.ignore :] for m, record in zip(modelled, records, strict=True)]
        data, responses_um = FitData(records, self._unit), np.concatenate(bare)
        how = f"{len(records)} recordings, held out in turn"
        if own:
            responses_um = data.with_creep(responses_um)
            how += ", without an offset and creep per recording"
        return HeldOut(judgement_of(data, responses_um, self._rule.range_um), records, how)


STILL_S = 1.0  # between a run and the one that began where it ended


def load_runs(paths: Sequence[Path], model: HysteresisModel) -> list[History]:
    """Read runs, each from rest, or after the run that it continues, which is not evaluated."""
    if not paths:
        raise InputError("no recordings to refine the model: name at least one")
    twice = {path for path in paths if list(paths).count(path) > 1}
    if twice:
        raise InputError(f"named twice: {', '.join(map(str, sorted(twice)))}")
    recordings = [read(path) for path in paths]
    for recording in recordings:
        if recording.command_unit != model.input_unit:
            raise DataError(
                f"{recording.path}: was recorded in {recording.command_unit}, the model takes "
                f"{model.input_unit}"
            )
    known = {recording.run.get("run_id", ""): recording for recording in recordings}
    return [_history(recording, known) for recording in recordings]


def _history(recording: Recording, known: Mapping[str, Recording]) -> History:
    history = history_from_pieces([recording])
    before = recording.run.get("initial_state_run_id", "")
    conditioned = (recording.samples.flags & Flag.CONDITION.value).any()
    if not before or conditioned:
        return history
    if before not in known:
        raise DataError(
            f"{recording.path}: began {recording.run.get('initial_state', 'where a run ended')}. "
            "Add that recording, so that the initial state is known"
        )
    first = known[before].samples
    last = float(first.command[-1])
    still = round(STILL_S * recording.sample_rate_hz)
    command = np.concatenate((first.command, np.full(still, last), history.command))
    ahead = np.zeros(command.size - history.command.size)  # not evaluated
    displacement_um = np.concatenate((ahead, history.displacement_um))
    ignore = ahead.size + history.ignore
    held = history.held + ahead.size
    return replace(
        history, command=command, displacement_um=displacement_um, ignore=ignore, held=held
    )


@shown_briefly
@dataclass(frozen=True, slots=True)
class Refinement:
    """A refined model, and its errors.

    Attributes:
        choice: Selected regularisation, with errors before and after on held-out runs.
        fitted_ratio: Error after over error before on the runs that it was fitted to.
        reasons: Why it is no better than the old model; empty if it is better.
    """

    model: RefinedModel
    choice: SelectedRegularisation
    fitted_ratio: float
    reasons: tuple[str, ...]

    @property
    def better(self) -> bool:
        """Whether it is better than the old model on held-out runs."""
        return not self.reasons

    @property
    def worse(self) -> list[ErrorChange]:
        """Held-out runs whose error increases."""
        return [run for run in self.choice.runs if run.increase > 0.0]

    @property
    def limit(self) -> str:
        """What limits the gain on held-out runs; empty if it is large or zero."""
        if not self.better or self.choice.ratio <= LARGE_GAIN:
            return ""
        fitted = f"the error of fitted runs is {self.fitted_ratio:.2f} times the old one"
        if self.fitted_ratio <= LARGE_GAIN:
            return f"{fitted}: add runs of more strokes, places and frequencies"
        return f"{fitted}: the rest is noise or drift, or needs a new model (hilctl characterise)"

    def __str__(self) -> str:
        if not self.better:
            return f"no better than the old model: {'; '.join(self.reasons)}"
        return (
            f"better: {self.choice.ratio:.2f} times the old error on held-out runs; worst class: "
            f"{worst_class(self.choice.classes)}; "
            f"{len(self.worse)} of {len(self.choice.runs)} runs worse"
            f"{self.limit and '; '}{self.limit}"
        )

    def to_mapping(self) -> dict[str, Any]:
        """Return all figures as plain mappings, lists and numbers, for JSON."""
        return {
            "better": self.better,
            "text": str(self),
            "reasons": list(self.reasons),
            "ratio": self.choice.ratio,
            "fitted_ratio": self.fitted_ratio,
            "limit": self.limit,
            "strength": self.choice.strength,
            "anchor": self.choice.anchor,
            "own_drift": self.choice.own,
            "classes": [asdict(each) for each in self.choice.classes],
            "worse": [asdict(each) for each in self.worse],
            "before": self.choice.before.to_mapping(),
            "after": self.choice.after.to_mapping(),
        }


def refine_runs(
    old: HysteresisModel,
    runs: Sequence[History],
    validate: Sequence[History] = (),
    source: str = "",
    progress: OnProgress = ignore_progress,
    tolerance_percent: float = TOLERANCE_PERCENT,
) -> Refinement:
    """Refine a model from runs, and evaluate it on held-out runs."""
    if reasons := tuple(data_reasons([*runs, *validate])):
        raise InputError("\n".join(reasons))
    parts, splits = parts_of(runs, validate)
    ends_um = old.output_range_um
    runs_um = [run.displacement_um[run.ignore :] for run in parts]
    range_um = float(np.ptp(ends_um) if ends_um else max(map(np.ptp, runs_um)))
    rule = AcceptanceRule(range_um, tolerance_percent)
    regularisation = Regularisation(old, parts, splits, rule)
    choice, refined = regularisation.best(progress)
    fitted_ratio = regularisation.fitted_ratio(refined, own=choice.own)
    progress(1.0, "done")
    named = refined.model_copy(update={"provenance": _provenance(old, runs, choice, source)})
    return Refinement(named, choice, fitted_ratio, tuple(choice.reasons))


def _provenance(
    old: HysteresisModel, runs: Sequence[History], choice: SelectedRegularisation, source: str
) -> Provenance:
    was = old.provenance
    data = FitData(runs, old.input_unit)
    figures = {f"held_out_{k}": v for k, v in error_table(choice.after.judgement).items()}
    by_stroke = {each.label: each.peak_percent for each in choice.after.judgement.classes}
    labels = tuple(run.label for run in runs)
    return was.model_copy(
        update={
            "source": (*was.source, *([source] if source else []), *labels),
            "method": f"{was.method}; refined on {len(runs)} runs, strength {choice.strength:g}",
            "errors_percent": figures,
            "errors_by_stroke": {**was.errors_by_stroke, **by_stroke},
            "identified_range": _wider(was.identified_range, identified_range(data)),
            "versions": VERSIONS,
            "created": datetime.now(UTC).isoformat(timespec="seconds"),
        }
    )


def _wider(old: IdentifiedRange | None, new: IdentifiedRange) -> IdentifiedRange:
    """Return the union of both ranges: beyond the runs, the old model still holds."""
    if old is None:
        return new
    moves, turns = (old.peak_to_peak_um, new.peak_to_peak_um), (old.frequency_hz, new.frequency_hz)
    return IdentifiedRange(
        peak_to_peak_um=(min(a for a, _ in moves), max(b for _, b in moves)),
        frequency_hz=(min(a for a, _ in turns), max(b for _, b in turns)),
        speed_um_per_s=max(old.speed_um_per_s, new.speed_um_per_s),
    )
