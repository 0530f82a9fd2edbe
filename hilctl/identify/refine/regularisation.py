"""Selection of the regularisation towards the old model, by held-out runs."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from hilctl.base.errors import DataError
from hilctl.identify.data.records import History
from hilctl.identify.evaluation import judgement_of
from hilctl.identify.fit_api import FitData, OnProgress
from hilctl.identify.model_selection import HeldOut, folds_of
from hilctl.identify.refine.residual_fit import ResidualFit
from hilctl.models.base import HysteresisModel
from hilctl.models.refined import RefinedModel

STRENGTHS = (0.003, 0.01, 0.02, 0.03, 0.05, 0.1, 0.3, 1.0)
ANCHORS = (100.0, 10.0, 3.0)
"""Weights of the old model on motions of its whole range, of the least weight."""
AS_GOOD = 1.02  # of the least error on held-out runs
WORTH = 0.9  # maximum error, of the old one: a smaller gain is not worth the risk
STRETCHES = 10  # parts of a run that are evaluated separately
MOST = 1.12  # maximum error of a part, of the old one
FOREGONE = 0.5  # part of the possible gain that even errors may cost
LOSS = 0.5  # maximum loss on one run, of the mean gain


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

    @property
    def worse(self) -> tuple[str, ...]:
        """Labels of held-out runs that lose more than a part of the mean gain."""
        most = 1.0 + LOSS * max(1.0 - self.ratio, 0.0)
        pairs = zip(self.after.judgement.errors, self.before.judgement.errors, strict=True)
        return tuple(now.label for now, was in pairs if now.rms_percent > most * was.rms_percent)

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
        """Error after over error before: root mean square of the relative errors of the runs."""
        after, before = (
            np.mean([error.rms_percent**2 for error in held.judgement.errors])
            for held in (self.after, self.before)
        )
        return float(np.sqrt(after / before))

    @property
    def better(self) -> bool:
        """Whether it is better than the old model, and worse on no run."""
        return self.ratio <= WORTH and not self.worse

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
    ) -> None:
        self._parts, self._splits, self._unit = parts, splits, model.input_unit
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
        # Beyond the motions of the runs the old model is kept, if that costs almost nothing.
        if not best[0].better:
            return best
        held = [self._tried(best[0].strength, anchor, own=own)[:2] for anchor in ANCHORS]
        least = min([best, *held], key=lambda way: (not way[0].better, way[0].ratio))
        good = (way for way in held if way[0].as_good(best[0]) and way[0].as_good(least[0]))
        return next(good, best)

    def _tried(
        self, strength: float, anchor: float, *, own: bool
    ) -> tuple[SelectedRegularisation, RefinedModel, float]:
        """Return a regularisation, its model of all runs, and its error on held-out runs."""
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
        how = f"{len(records)} recordings, each held out of one fit"
        if own:
            responses_um = data.with_creep(responses_um)
            how += ", without an offset and creep per recording"
        return HeldOut(judgement_of(data, responses_um), records, how)
