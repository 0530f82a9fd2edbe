"""How firmly the old model is held to: what does best on runs that it was not refined on."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from hilctl.base.errors import DataError
from hilctl.base.types import F64, CommandUnit
from hilctl.identify.data.records import History
from hilctl.identify.evaluation import judgement_of
from hilctl.identify.fit_api import FitData, OnProgress
from hilctl.identify.model_selection import HeldOut, folds_of
from hilctl.identify.refine.residual_fit import NormalEquations, ResidualFit
from hilctl.models.base import HysteresisModel
from hilctl.models.refined import RefinedModel

STRENGTHS = (0.003, 0.01, 0.02, 0.03, 0.05, 0.1, 0.3, 1.0)
ANCHORS = (100.0, 10.0, 3.0)
"""Times the least weight of the old model on motions that runs may say nothing of."""
AS_GOOD = 1.02  # times the least error on runs held out
WORTH = 0.9  # of the old error: less gain is not worth what runs do not show
STRETCHES = 10  # of a run, each of them judged by itself
MOST = 1.12  # times the old error of any one: shorter than a run, they are known less well
FOREGONE = 0.5  # of what could be gained: no more is left for the sake of such a stretch
LOSS = 0.5  # of what is gained in the mean: more must not be lost on any one run


@dataclass(frozen=True, slots=True)
class RegularisationSplit:
    """What is fitted, and what is judged, by their numbers among all runs."""

    fitted: tuple[int, ...]
    judged: tuple[int, ...]


@dataclass(frozen=True, slots=True)
class SelectedRegularisation:
    """A way to refine, and what it did on runs held out.

    Attributes:
        strength: How firmly the old model is held to.
        anchor: Times the least weight that it has on motions of its whole range.
        own: Whether runs have constants, creep and drift of their own.
        before: Errors of the old model on what was held out.
        after: Errors of the refined ones, each fitted without the run that it is judged on.
    """

    strength: float
    anchor: float
    own: bool
    before: HeldOut
    after: HeldOut

    @property
    def worse(self) -> tuple[str, ...]:
        """Labels of runs held out that lose more than their part of what all gain.

        The last run of its kind is judged by a model that has seen none, the model that is written
        has seen all.
        """
        most = 1.0 + LOSS * max(1.0 - self.ratio, 0.0)
        pairs = zip(self.after.judgement.errors, self.before.judgement.errors, strict=True)
        return tuple(now.label for now, was in pairs if now.rms_percent > most * was.rms_percent)

    @property
    def even(self) -> bool:
        """Whether no stretch of a run is worse by more than such a short one tells.

        Small motions are stretches of larger runs: what they lose does not show in all of it.
        """
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
        """Error after over error before: root mean square over runs, each of its own motion."""
        after, before = (
            np.mean([error.rms_percent**2 for error in held.judgement.errors])
            for held in (self.after, self.before)
        )
        return float(np.sqrt(after / before))

    @property
    def better(self) -> bool:
        """Whether it is better than the old model, and on no run worse."""
        return self.ratio <= WORTH and not self.worse

    def as_good(self, other: "SelectedRegularisation") -> bool:
        """Return whether it is as good as another way, or next to."""
        fair = self.better >= other.better and self.even >= other.even
        return fair and self.ratio <= AS_GOOD * other.ratio


def parts_of(
    runs: Sequence[History], validate: Sequence[History]
) -> tuple[tuple[History, ...], tuple[RegularisationSplit, ...]]:
    """Return what is fitted or judged, and which in turn.

    Of several runs each is held out once; of one, its last part; where there are others to validate
    with, these.

    Raises:
        DataError: There is too little.
    """
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
        raise DataError(
            f"{runs[0].label}: too little of it can be held out to judge by: give more recordings"
        )
    head, tail = folds[0].fitted[0], folds[0].held_out[0]
    assert isinstance(head, History)
    assert isinstance(tail, History)
    return (head, tail), (RegularisationSplit((0,), (1,)),)


class Regularisation:
    """Tries ways to refine on runs held out.

    Args:
        model: The old model.
        parts: What is fitted or judged.
        splits: Which in turn.
        unit: Unit of the command.
    """

    def __init__(
        self,
        model: HysteresisModel,
        parts: Sequence[History],
        splits: Sequence[RegularisationSplit],
        unit: CommandUnit,
    ) -> None:
        self._parts, self._splits, self._unit = parts, splits, unit
        # All that is not only there to be judged; of one run that is cut in two, its end too.
        fitted = {i for split in splits for i in split.fitted}
        cut = parts[-1].label == parts[0].label
        self._whole = tuple(range(len(parts))) if cut else tuple(sorted(fitted))
        self._remainder = ResidualFit(model, parts, [parts[i] for i in sorted(fitted)])
        self._anchor = self._remainder.anchor()
        self._moments = {own: self._remainder.moments(own=own) for own in (False, True)}
        old = dict.fromkeys(splits, model)
        self._before = {own: self._held_out(old, own=own) for own in (False, True)}

    def best(self, progress: OnProgress) -> tuple[SelectedRegularisation, RefinedModel]:
        """Return the way that does best, and the model that it makes of all runs.

        Where none is better than the old model on what was held out, it is the best all the same.
        """
        found: list[tuple[SelectedRegularisation, RefinedModel, float]] = []
        ways = [(strength, own) for own in (False, True) for strength in STRENGTHS]
        for i, (strength, own) in enumerate(ways):
            progress(i / len(ways), f"strength {strength:g}")
            found.append(self._tried(strength, 1.0, own=own))
        # Small loops stand where hysteresis has left them, so a constant of a run's own would take
        # what is to be learned; it is one only where runs held out do better for it as they are.
        own = min(found, key=lambda each: each[2])[0].own
        left = [(choice, whole) for choice, whole, _ in found if choice.own == own]
        best = min(left, key=lambda way: (not way[0].better, way[0].ratio))
        least_gain = FOREGONE * (1.0 - best[0].ratio)
        even = [way for way in left if way[0].even and way[0].better]
        even = [way for way in even if 1.0 - way[0].ratio >= least_gain]
        best = min(even, key=lambda way: way[0].ratio, default=best)
        # Runs say nothing of what is faster or larger than they are: where holding to the old model
        # there costs them next to nothing, it is held to.
        if not best[0].better:
            return best
        held = [self._tried(best[0].strength, anchor, own=own)[:2] for anchor in ANCHORS]
        least = min([best, *held], key=lambda way: (not way[0].better, way[0].ratio))
        good = (way for way in held if way[0].as_good(best[0]) and way[0].as_good(least[0]))
        return next(good, best)

    def _tried(
        self, strength: float, anchor: float, *, own: bool
    ) -> tuple[SelectedRegularisation, RefinedModel, float]:
        """Return a way to refine, what it makes of all runs, and its error on those held out."""
        models = {s: self._refined(s.fitted, strength, anchor, own=own) for s in self._splits}
        after = self._held_out(models)
        bare = self._held_out(models, own=True) if own else after
        choice = SelectedRegularisation(strength, anchor, own, self._before[own], bare)
        whole = self._refined(self._whole, strength, anchor, own=own)
        return choice, whole, after.judgement.rms_percent

    def _refined(
        self, fitted: Sequence[int], strength: float, anchor: float, *, own: bool
    ) -> RefinedModel:
        sums = self._anchor.scaled(anchor)
        for i in fitted:
            sums += self._moments[own][i]
        return self._remainder.model(self._solved(sums, strength))

    def _solved(self, sums: NormalEquations, strength: float) -> F64:
        firm = self._remainder.firm(strength, sums)
        # What is held small is what is new: the anchor says what has been.
        return np.asarray(np.linalg.solve(sums.normal + firm, sums.right), dtype=np.float64)

    def _held_out(
        self, models: Mapping[RegularisationSplit, HysteresisModel], *, own: bool = False
    ) -> HeldOut:
        judged = [(i, model) for split, model in models.items() for i in split.judged]
        records = tuple(self._parts[i] for i, _ in judged)
        modelled = [self._remainder.modelled_um(model, i) for i, model in judged]
        bare = [m[record.ignore :] for m, record in zip(modelled, records, strict=True)]
        data, responses_um = FitData(records, self._unit), np.concatenate(bare)
        how = f"{len(records)} recordings, none of them fitted where it is judged"
        if own:
            mine = np.linalg.lstsq(data.creep, data.target_um - responses_um, rcond=None)[0]
            responses_um = responses_um + data.creep @ mine
            how += ", each less a constant and creep of its own"
        return HeldOut(judgement_of(data, responses_um), records, how)
