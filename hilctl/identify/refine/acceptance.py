"""Acceptance of a refined model by its errors on held-out runs.

References are classified by their stroke. The worst class must improve; single runs may get a
little worse.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

from hilctl.base.errors import InputError
from hilctl.identify.evaluation import LoopScore

CLASSES = {"full stroke": 1.0, "half stroke": 0.5, "quarter stroke": 0.25, "tenth stroke": 0.1}
"""Peak-to-peak of the references of a class, of the model's range."""
WORTH = 0.9  # error of one class, of the old one: a smaller gain is not worth the risk
LOSS = 0.1  # of its old error, by which each run may get worse
TOLERANCE_PERCENT = 0.2


@dataclass(frozen=True, slots=True)
class ErrorChange:
    """Rms error of a run or class before and after, in percent of the runs' peak-to-peak."""

    label: str
    peak_to_peak_um: float
    before: float
    after: float

    @property
    def increase(self) -> float:
        """Increase of the error, in percent of the peak-to-peak."""
        return self.after - self.before

    def __str__(self) -> str:
        return f"{self.label}: rms error {self.after:.3g} % (before {self.before:.3g} %)"


def error_changes(
    before: Sequence[LoopScore], after: Sequence[LoopScore]
) -> tuple[ErrorChange, ...]:
    """Return the change of each run's error."""
    pairs = zip(before, after, strict=True)
    return tuple(
        ErrorChange(was.label, was.peak_to_peak_um, was.rms_percent, now.rms_percent)
        for was, now in pairs
    )


def worst_class(classes: Sequence[ErrorChange]) -> ErrorChange:
    """Return the class with the largest error after, and the largest error of a class before."""
    worst = max(classes, key=lambda each: each.after)
    return replace(worst, before=max(each.before for each in classes))


@dataclass(frozen=True, slots=True)
class AcceptanceRule:
    """Rule by which a refined model replaces the old one.

    Attributes:
        range_um: Range of the model, by which runs are classified.
        tolerance_percent: Increase of a run's rms error to accept, in percent of its peak-to-peak;
            a tenth of its old error is always accepted.
    """

    range_um: float
    tolerance_percent: float = TOLERANCE_PERCENT

    def __post_init__(self) -> None:
        if not 0.0 <= self.tolerance_percent <= 100.0:
            raise InputError(
                f"tolerance_percent must be from 0 to 100 (got {self.tolerance_percent:g}). "
                f"The default is {TOLERANCE_PERCENT:g}"
            )

    def classes(self, runs: Sequence[ErrorChange]) -> list[ErrorChange]:
        """Return the root mean square of the errors of each class that has runs."""
        members: dict[str, list[ErrorChange]] = {name: [] for name in CLASSES}
        for run in runs:
            members[self._class_of(run.peak_to_peak_um)].append(run)
        return [
            ErrorChange(
                name,
                max(run.peak_to_peak_um for run in found),
                _rms([run.before for run in found]),
                _rms([run.after for run in found]),
            )
            for name, found in members.items()
            if found
        ]

    def reasons(self, runs: Sequence[ErrorChange]) -> list[str]:
        """Return why the refined model is not accepted; empty if it is."""
        classes, reasons = self.classes(runs), []
        best = min(classes, key=lambda each: each.after - WORTH * each.before)
        if best.after > WORTH * best.before:
            reasons.append(
                f"no class of references gains a tenth (best: {best}), so the rest is noise or "
                "drift, or beyond this kind of model"
            )
        if (worst := worst_class(classes)).increase >= 0.0:
            reasons.append(f"the worst class does not improve ({worst})")
        if refused := [run for run in runs if run.increase > self._most(run)]:
            cure = ""
            if not reasons:
                least = math.ceil(100.0 * max(run.increase for run in refused)) / 100.0
                cure = (
                    ". Add runs of similar stroke and frequency, or accept it with "
                    f"--tolerance-percent {least:g}"
                )
            reasons.append(
                "held-out runs get worse by more than a tenth and "
                f"{self.tolerance_percent:g} % of their peak-to-peak: "
                f"{', '.join(map(str, refused))}{cure}"
            )
        return reasons

    def _most(self, run: ErrorChange) -> float:
        return max(LOSS * run.before, self.tolerance_percent)

    def _class_of(self, peak_to_peak_um: float) -> str:
        return min(
            CLASSES, key=lambda name: abs(math.log(peak_to_peak_um / self.range_um / CLASSES[name]))
        )


def _rms(errors: Sequence[float]) -> float:
    return math.sqrt(math.fsum(error**2 for error in errors) / len(errors))
