"""How firmly the old model is held to: what does best on runs that it was not refined on."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from pydantic import ValidationError

from hilctl.base.arrays import F64
from hilctl.base.device import CommandUnit
from hilctl.base.errors import DataError
from hilctl.identify.data.records import History
from hilctl.identify.fit_data import FitData
from hilctl.identify.held_out import HeldOut, folds_of
from hilctl.identify.job import OnProgress
from hilctl.identify.judge import judgement_of
from hilctl.identify.refine.remainder import Moments, Remainder
from hilctl.models.base import HysteresisModel
from hilctl.models.refined import RefinedModel

STRENGTHS = (0.003, 0.01, 0.02, 0.05, 0.1, 0.3, 1.0)
WORTH = 0.98  # of the old error: what is not less is no better
WORSE = 1.05  # of the old error of one run: what is more is worse


@dataclass(frozen=True, slots=True)
class Split:
    """What is fitted, and what is judged, by their numbers among all runs."""

    fitted: tuple[int, ...]
    judged: tuple[int, ...]


@dataclass(frozen=True, slots=True)
class Choice:
    """A way to refine, and what it did on runs held out.

    Attributes:
        strength: How firmly the old model is held to.
        own: Whether runs have constants, creep and drift of their own.
        before: Errors of the old model on what was held out.
        after: Errors of the refined ones, each fitted without the run that it is judged on.
    """

    strength: float
    own: bool
    before: HeldOut
    after: HeldOut

    @property
    def worse(self) -> tuple[str, ...]:
        """Labels of runs held out on which it is worse than the old model."""
        pairs = zip(self.after.judgement.errors, self.before.judgement.errors, strict=True)
        return tuple(now.label for now, was in pairs if now.rms_percent > WORSE * was.rms_percent)

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


def parts_of(
    runs: Sequence[History], validate: Sequence[History]
) -> tuple[tuple[History, ...], tuple[Split, ...]]:
    """Return what is fitted or judged, and which in turn.

    Of several runs each is held out once; of one, its last part; where there are others to validate
    with, these.

    Raises:
        DataError: There is too little.
    """
    every = tuple(range(len(runs)))
    if validate:
        others = tuple(range(len(runs), len(runs) + len(validate)))
        return (*runs, *validate), (Split(every, others),)
    if len(runs) > 1:
        return tuple(runs), tuple(Split((*every[:i], *every[i + 1 :]), (i,)) for i in every)
    folds = folds_of(runs)
    if not folds:
        raise DataError(
            f"{runs[0].label}: too little of it can be held out to judge by: give more recordings"
        )
    head, tail = folds[0].fitted[0], folds[0].held_out[0]
    assert isinstance(head, History)
    assert isinstance(tail, History)
    return (head, tail), (Split((0,), (1,)),)


class Strength:
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
        splits: Sequence[Split],
        unit: CommandUnit,
    ) -> None:
        self._remainder = Remainder(model, parts)
        self._parts, self._splits, self._unit = parts, splits, unit
        self._anchor = self._remainder.anchor()
        self._moments = {own: self._remainder.moments(own=own) for own in (False, True)}
        self._before = self._held_out(dict.fromkeys(splits, model))

    def best(self, progress: OnProgress) -> tuple[Choice, RefinedModel]:
        """Return the way that does best, and the model that it makes of all runs.

        Where none is better than the old model on what was held out, it is the best all the same.

        Raises:
            DataError: None has an inverse.
        """
        found: list[tuple[Choice, RefinedModel]] = []
        ways = [(strength, own) for strength in STRENGTHS for own in (False, True)]
        for i, (strength, own) in enumerate(ways):
            progress(i / len(ways), f"strength {strength:g}")
            found += self._tried(strength, own=own)
        if not found:
            raise DataError("whatever its strength, what was found has no inverse")
        found.sort(key=lambda each: (not each[0].better, each[0].ratio))
        return found[0]

    def _tried(self, strength: float, *, own: bool) -> Iterator[tuple[Choice, RefinedModel]]:
        try:
            models = {
                split: self._refined(split.fitted, strength, own=own) for split in self._splits
            }
            # One run alone is two parts of which the second is judged: all of it is fitted then.
            fitted = {i for split in self._splits for i in split.fitted}
            if len(self._splits) == 1 and self._parts[-1].label == self._parts[0].label:
                fitted.add(1)
            whole = self._refined(tuple(sorted(fitted)), strength, own=own)
        except ValidationError:  # of a slope that has no inverse: firmer ones have
            return
        yield Choice(strength, own, self._before, self._held_out(models)), whole

    def _refined(self, fitted: Sequence[int], strength: float, *, own: bool) -> RefinedModel:
        sums = self._anchor
        for i in fitted:
            sums += self._moments[own][i]
        return self._remainder.model(self._solved(sums, strength))

    def _solved(self, sums: Moments, strength: float) -> F64:
        firm = self._remainder.firm(strength, sums)
        # What is held small is what is new: the anchor says what has been.
        return np.asarray(np.linalg.solve(sums.normal + firm, sums.right), dtype=np.float64)

    def _held_out(
        self, models: dict[Split, HysteresisModel] | dict[Split, RefinedModel]
    ) -> HeldOut:
        judged = [(i, model) for split, model in models.items() for i in split.judged]
        records = tuple(self._parts[i] for i, _ in judged)
        modelled = [self._remainder.modelled_um(model, i) for i, model in judged]
        bare = [m[record.ignore :] for m, record in zip(modelled, records, strict=True)]
        how = f"{len(records)} recordings, none of them fitted where it is judged"
        judgement = judgement_of(FitData(records, self._unit), np.concatenate(bare))
        return HeldOut(judgement, records, how)
