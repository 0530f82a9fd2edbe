"""Acceptance of a refined model by its errors on held-out runs.

References are classified by their stroke. The worst class must improve; single runs may get a
little worse.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from hilctl.base.errors import InputError
from hilctl.lab.identify.evaluation import LoopScore
from hilctl.models.base import STROKES, stroke_class
from hilctl.signals import cycle_metrics

WORTH = 0.9  # error of one class, of the old one: a smaller gain is not worth the risk
LOSS = 0.1  # of its old error, by which each run may get worse
TOLERANCE_PERCENT = 0.2
PEAK = 3.0  # times the tolerance, by which a run's peak error may rise: noise raises it as well


@dataclass(frozen=True, slots=True)
class ErrorChange:
    """Errors of a run or class before and after, in percent of the runs' peak-to-peak."""

    label: str
    peak_to_peak_um: float
    before: float  # rms
    after: float
    peak_before: float
    peak_after: float

    @property
    def increase(self) -> float:
        """Increase of the error, in percent of the peak-to-peak."""
        return self.after - self.before

    @property
    def peak_increase(self) -> float:
        """Increase of the largest error, in percent of the peak-to-peak."""
        return self.peak_after - self.peak_before

    def __str__(self) -> str:
        rms = f"rms error {self.after:.3g} % (before {self.before:.3g} %)"
        return (
            f"{self.label}: {rms}, peak {self.peak_after:.3g} % (before {self.peak_before:.3g} %)"
        )


def error_changes(
    before: Sequence[LoopScore], after: Sequence[LoopScore]
) -> tuple[ErrorChange, ...]:
    """Return the change of each run's error."""
    pairs = zip(before, after, strict=True)
    return tuple(
        ErrorChange(
            was.label,
            was.peak_to_peak_um,
            was.rms_percent,
            now.rms_percent,
            was.peak_percent,
            now.peak_percent,
        )
        for was, now in pairs
    )


def error_ratio(runs: Sequence[ErrorChange]) -> float:
    """Return error after over error before: root mean square of the relative errors of runs."""
    after, before = (
        np.mean([error**2 for error in errors])
        for errors in zip(*((run.after, run.before) for run in runs), strict=True)
    )
    return float(np.sqrt(after / before))


def worst_class(classes: Sequence[ErrorChange]) -> ErrorChange:
    """Return the class with the largest error after, and the largest error of a class before."""
    worst = max(classes, key=lambda each: each.after)
    return replace(
        worst,
        before=max(each.before for each in classes),
        peak_before=max(each.peak_before for each in classes),
    )


@dataclass(frozen=True, slots=True)
class AcceptanceRule:
    """Rule by which a refined model replaces the old one.

    A run's rms error may increase by a tolerance in percent of its peak-to-peak, its peak error by
    three times that. A tenth of its old error is always accepted.
    """

    range_um: float  # range of the model, by which runs are classified
    tolerance_percent: float = TOLERANCE_PERCENT

    def __post_init__(self) -> None:
        if not 0.0 <= self.tolerance_percent <= 100.0:
            raise InputError(
                f"tolerance_percent must be from 0 to 100 (got {self.tolerance_percent:g}). "
                f"The default is {TOLERANCE_PERCENT:g}"
            )

    def classes(self, runs: Sequence[ErrorChange]) -> list[ErrorChange]:
        """Return the root mean square of the errors of each class that has runs."""
        members: dict[str, list[ErrorChange]] = {name: [] for name in STROKES}
        for run in runs:
            members[stroke_class(run.peak_to_peak_um / self.range_um)].append(run)
        return [
            ErrorChange(
                name,
                max(run.peak_to_peak_um for run in found),
                cycle_metrics.rms(np.array([run.before for run in found])),
                cycle_metrics.rms(np.array([run.after for run in found])),
                max(run.peak_before for run in found),
                max(run.peak_after for run in found),
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
        if refused := [run for run in runs if self._excess(run) > 0.0]:
            cure = ""
            if not reasons:
                worst_run = max(max(run.increase, run.peak_increase / PEAK) for run in refused)
                least = math.ceil(100.0 * worst_run) / 100.0
                cure = (
                    ". Add runs of similar stroke and frequency, or accept it with "
                    f"--tolerance-percent {least:g}"
                )
            reasons.append(
                "held-out runs get worse by more than a tenth and "
                f"{self.tolerance_percent:g} % rms or {PEAK * self.tolerance_percent:g} % peak of "
                "their peak-to-peak: "
                f"{', '.join(map(str, refused))}{cure}"
            )
        return reasons

    def _excess(self, run: ErrorChange) -> float:
        most = max(LOSS * run.before, self.tolerance_percent)
        most_peak = max(LOSS * run.peak_before, PEAK * self.tolerance_percent)
        return max(run.increase - most, run.peak_increase - most_peak)
