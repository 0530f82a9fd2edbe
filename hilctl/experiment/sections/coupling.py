"""The ``coupling`` key: identified crosstalk between axes, and its removal before a run.

The sensor of an axis also sees the displacements of others, through the linear filters ``G`` of the
frame. References are known in advance, so the crosstalk of the whole run is subtracted from them:
the inputs ``h`` of the compensators solve ``h = r - G h``.

Each filter is an FIR that may look ahead. Its taps are ``spacing`` samples apart, smoothed by four
moving averages over ``spacing`` samples (a cubic B-spline), so that a few of them describe a slow
resonance at a high sample rate.
"""

import hashlib
import math
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Annotated, Self

import numpy as np

from hilctl.base.axes import names_text
from hilctl.base.errors import ConfigProblem, broken
from hilctl.base.files import TextFiles, write_text
from hilctl.base.strict import Field, StrictModel, model_validator
from hilctl.base.types import F64
from hilctl.base.yaml import commented, load_document
from hilctl.experiment.sections.feedback import (
    AnyFeedbackConfig,
    PiFeedbackConfig,
    bandwidth_of,
    feedback_gains,
)
from hilctl.models.base import HysteresisModel

MOST_ROW_SUM = 0.5
"""Largest sum of the crosstalk into one axis at any frequency, relative to equal motions."""
MOST_WITH_PI = 0.3
"""The same below the crossover of a PI controller."""

_GRADES = {"good": 15.0, "usable": 30.0}  # largest residual of a crosstalk, percent
_LEFT = 1e-6  # of the crosstalk, after the last iteration
_SAME_RATE = 1e-6
_POINTS = 1 << 15  # fewest samples of a transform


class CrosstalkFilter(StrictModel):
    """Crosstalk from the displacement of one axis into the sensor of another."""

    first_sample: int = 0  # delay of the first tap; negative if it looks ahead
    spacing: Annotated[int, Field(ge=1)] = 1
    taps: Annotated[tuple[float, ...], Field(min_length=1)]  # one is a static gain
    coherence: float  # mean over the measured frequencies, 0 to 1
    noise_percent: float  # rms error of the measurement, of the crosstalk
    residual_percent: float  # rms error of the taps at frequencies left out, of the crosstalk
    left_hz: tuple[float, ...] = ()  # centres of octaves
    left_percent: tuple[float, ...] = ()  # measured with this coupling in use, of the crosstalk

    @property
    def grade(self) -> str:
        """``good``, ``usable`` or ``poor``, by the residual."""
        found = (word for word, most in _GRADES.items() if self.residual_percent <= most)
        return next(found, "poor")

    def response(self) -> tuple[F64, int]:
        """Return the impulse response, float64[n], and the delay of its first sample."""
        average = np.full(self.spacing, 1.0 / self.spacing)
        apart = np.zeros((len(self.taps) - 1) * self.spacing + 1)
        apart[:: self.spacing] = self.taps
        for _ in range(4):
            apart = np.convolve(apart, average)
        return apart, self.first_sample - 2 * (self.spacing - 1)


class Coupling(StrictModel):
    """Crosstalk between the axes of a stage."""

    axes: Annotated[tuple[str, ...], Field(min_length=2)]
    sample_rate_hz: Annotated[float, Field(gt=0.0)]
    highest_hz: Annotated[float, Field(gt=0.0)]  # highest measured frequency
    # By the axis of the sensor and the axis that moves; without a pair there is no crosstalk.
    into: Mapping[str, Mapping[str, CrosstalkFilter]]
    provenance: Mapping[str, str] = Field(default_factory=dict)

    @model_validator(mode="after")
    def _known(self) -> Self:
        for axis, others in self.into.items():
            if unknown := {axis, *others} - {*self.axes}:
                raise ValueError(f"must name axes of the coupling: {sorted(unknown)}")
            if axis in others:
                raise ValueError(f"must not name an axis for its own sensor: {axis}")
        return self

    def crosstalk(self, own_um: Mapping[str, F64]) -> dict[str, F64]:
        """Return what each sensor sees of the other axes: float64[n] each, in um.

        ``own_um`` are their own displacements from rest, which hold before and after.
        """
        found = {axis: np.zeros_like(own) for axis, own in own_um.items()}
        for axis, others in self.into.items():
            for other, through in others.items():
                found[axis] += _filtered(own_um[other], *through.response())
        return found

    def removed(
        self, wanted_um: Mapping[str, F64], rests_um: Mapping[str, float]
    ) -> dict[str, F64]:
        """Return the crosstalk that the inputs ``wanted_um - crosstalk`` will cause.

        Args:
            wanted_um: float64[n] of each axis, its displacement.
            rests_um: Where each axis rests; there, crosstalk is part of the others' offsets.
        """
        found = {axis: np.zeros_like(values) for axis, values in wanted_um.items()}
        largest = max(self.row_sums()[1].max(), 1e-3)  # each step leaves this part of the error
        for _ in range(math.ceil(math.log(_LEFT) / math.log(largest))):
            own_um = {name: wanted_um[name] - found[name] - rests_um[name] for name in wanted_um}
            found = self.crosstalk(own_um)
        return found

    def row_sums(self) -> tuple[F64, F64]:
        """Return frequencies, float64[k], and the crosstalk into each axis: float64[axes, k]."""
        filters = {
            (axis, other): through.response()[0]
            for axis, others in self.into.items()
            for other, through in others.items()
        }
        size = _transform_size(max((each.size for each in filters.values()), default=1))
        sums = np.zeros((len(self.axes), size // 2 + 1))
        for (axis, _), taps in filters.items():
            sums[self.axes.index(axis)] += np.abs(np.fft.rfft(taps, size))
        hz = np.linspace(0.0, 0.5 * self.sample_rate_hz, size // 2 + 1)
        return hz, sums


class _CouplingFile(StrictModel):
    coupling: Coupling


def _transform_size(taps: int) -> int:
    return max(_POINTS, 1 << (8 * taps).bit_length())


def _filtered(values: F64, taps: F64, first: int) -> F64:
    """Return ``sum_m taps[m] values[k - first - m]``, float64[n], by transforms of pieces.

    The first and the last value hold before and after.
    """
    n, size = taps.size, _transform_size(taps.size)
    before, after = max(0, first + n - 1), max(0, -first)
    padded = np.pad(values, (before, after), mode="edge")
    begin, step = before - first - n + 1, size - n + 1
    spectrum, out = np.fft.rfft(taps, size), np.empty(values.size)
    for at in range(0, values.size, step):
        piece = np.fft.rfft(padded[begin + at :][:size], size)
        kept = out[at : at + step]
        kept[:] = np.fft.irfft(piece * spectrum, size)[n - 1 :][: kept.size]
    return out


def coupling_problems(
    coupling: Coupling | None, models: Mapping[str, HysteresisModel | None], rate_hz: float
) -> Iterator[ConfigProblem]:
    """Yield that a coupling is not for these axes at this rate, or cannot be removed.

    ``models`` are those of the compensators, by the names of the axes.
    """
    if coupling is None:
        return
    axes, was_hz, names = coupling.axes, coupling.sample_rate_hz, [*models]
    if {*names} != {*axes} or not math.isclose(rate_hz, was_hz, rel_tol=_SAME_RATE):
        now = names_text(names) if len(names) > 1 else "one axis"
        if {*names} == {*axes}:
            now = f"{rate_hz:g} Hz"
        rule = f"is for {names_text(axes)} at {was_hz:g} Hz, got {now}"
        yield broken("coupling", rule, hint="identify it with 'hilctl couple'")
        return
    if None in models.values():
        bare = names_text([name for name, model in models.items() if model is None])
        rule = f"needs a compensator on each axis, whose input it changes, got none on {bare}"
        yield broken("coupling", rule)
    hz, sums = coupling.row_sums()
    row, at = np.unravel_index(int(sums.argmax()), sums.shape)
    if not sums[row, at] < MOST_ROW_SUM:
        rule = f"the crosstalk into an axis must be < {MOST_ROW_SUM:g} of the motion of the others"
        value = f"{sums[row, at]:.2g} into {axes[int(row)]} at {hz[at]:.3g} Hz"
        yield broken("coupling", rule, value, "stiffen or damp the frame")


def coupled_feedback_problems(
    coupling: Coupling | None, axis: str, wanted: AnyFeedbackConfig | None, rate_hz: float
) -> Iterator[ConfigProblem]:
    """Yield that the PI controller of an axis would act on those of the others."""
    if coupling is None or axis not in coupling.axes or not isinstance(wanted, PiFeedbackConfig):
        return
    crossover_hz = bandwidth_of(wanted.kind, feedback_gains(wanted, rate_hz).ki_per_s, rate_hz)
    hz, sums = coupling.row_sums()
    below = sums[coupling.axes.index(axis), hz <= crossover_hz]
    if below.max() > MOST_WITH_PI:
        rule = f"crosstalk below the crossover of PI feedback must be <= {MOST_WITH_PI:g}"
        value = f"{below.max():.2g} at {hz[below.argmax()]:.3g} Hz"
        yield broken("feedback", rule, value, "lower the bandwidth, or use feedback.kind integral")


def coupling_sha256(coupling: Coupling | None) -> str | None:
    """Return the digest of a coupling's file content; None without a coupling."""
    return hashlib.sha256(dump_coupling(coupling).encode()).hexdigest() if coupling else None


def load_coupling(path: Path, files: TextFiles | None = None) -> Coupling:
    """Read a coupling file; raise InputError if it cannot be read or breaks a rule."""
    return load_document(path, files).validate(_CouplingFile).coupling


def dump_coupling(coupling: Coupling) -> str:
    """Return a coupling as YAML; reading it back gives the same one, bit for bit."""
    return commented({"coupling": coupling.model_dump(mode="json")}, {})


def write_coupling(path: Path, coupling: Coupling, *, overwrite: bool) -> None:
    """Write a coupling file atomically; raise InputError if that is not possible."""
    write_text(path, dump_coupling(coupling), overwrite=overwrite)
