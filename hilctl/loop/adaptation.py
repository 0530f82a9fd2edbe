"""Adaptation of the compensator's model during a run: offset, gain and the weights of some plays.

The difference between actuator and model is an operator of few parameters (kernels/gradient.py).
Its inverse precedes the model's inverse, for every kind of model. Its output is recorded as the
compensator's input, so the run replays like any other.

The parameters follow the gradient of the squared tracking error. The regressors are those of the
input that caused a displacement, delayed by compensator, sensor and device. They are orthogonalised
over the reference, so that all parameters converge equally fast and none replaces another (B.
Widrow and S. D. Stearns, "Adaptive Signal Processing", 1985, chapter 8; B. Widrow and E. Walach,
"Adaptive Inverse Control", 1996). Normalisation, a dead zone, leakage and projection keep the
parameters within their bounds for any displacement (P. A. Ioannou and J. Sun, "Robust Adaptive
Control", 1996, chapter 8). Their rate is limited as well.
"""

import math
from dataclasses import dataclass
from typing import Any, Self

import numpy as np

from hilctl.base.errors import InputError
from hilctl.base.events import ADAPTED, Event, adapted_text
from hilctl.base.types import F64, chunks
from hilctl.kernels import gradient as kernel
from hilctl.kernels.jit import ensure_compiled
from hilctl.loop.block import Block

THRESHOLDS = (0.15, 0.4, 0.7)
"""Thresholds of the plays, as shares of half the reference's span."""
_SMOOTHED = 0.1  # time constant of the smoothed gradient / that of the parameters
_LEAK = 0.01  # rate of leakage / that of the parameters: costs 1 % of gain and weights
_DEAD = 3.0  # standard deviations of the gradient's noise
_ALIKE = 1e-4  # of a mean square: regressors that differ by less count as equal
_RIDGE = 0.02  # of the mean squares: similar regressors are separated slowly
_LEAST_SLOPE = 0.3
_EVENT_S = 1.0
_EVENT_CHANGE = 0.1  # of a bound


@dataclass(frozen=True, slots=True)
class AdaptationBounds:
    """Largest deviations of the parameters from the identified ones; 0 fixes a parameter.

    Attributes:
        offset_um: Offset.
        gain: Gain, as a share.
        weight: Weight of each play, as a share of the gain.
    """

    offset_um: float
    gain: float
    weight: float

    def __post_init__(self) -> None:
        if not min(self.offset_um, self.gain, self.weight) >= 0.0:
            raise InputError(f"must be >= 0: {self.offset_um}, {self.gain}, {self.weight}")

    @property
    def array(self) -> F64:
        """The bounds in the parameters' order: float64[m]."""
        return np.array([self.offset_um, self.gain, *[self.weight] * len(THRESHOLDS)])


class DisplacementOperator:
    """Operator of the difference between actuator and model, for a reference.

    ``bounds`` is float64[m]; see :mod:`hilctl.kernels.gradient` for the other arrays.
    """

    def __init__(self, bounds: F64, settings: F64, table: F64, shape: F64) -> None:
        self.bounds, self.settings, self.table, self.shape = bounds, settings, table, shape
        self.thresholds = np.array(THRESHOLDS)
        self.constants = settings, table, shape, self.thresholds
        """The operator in the form of the kernels."""

    @classmethod
    def over(
        cls, reference_um: F64, bounds: AdaptationBounds, told: tuple[slice, ...] | None = None
    ) -> Self:
        """Return the operator for a reference, float64[n]; plays and centre follow from its span.

        ``told`` selects representative parts of the reference; None for all of it.

        Raises:
            InputError: The operator may have no inverse within these bounds.
        """
        spans = [(each.min(), each.max()) for each in chunks(reference_um, told)]
        low, high = float(np.min(spans)), float(np.max(spans))
        still = not high > low
        most = bounds.array
        if still:  # a constant reference only shows the offset
            most[kernel.GAIN :] = 0.0
        settings = np.zeros(kernel.SETTINGS)
        settings[kernel.MIDDLE_UM] = 0.5 * (low + high)
        settings[kernel.HALF_UM] = 1.0 if still else 0.5 * (high - low)
        table = np.stack([most, np.zeros(most.size), np.full(most.size, math.inf)])
        made = cls(most, settings, table, np.eye(most.size))
        made._orthogonalise(reference_um, told)
        least = made._least_slope()
        if not least >= _LEAST_SLOPE:
            raise InputError(f"the slope must stay above {_LEAST_SLOPE} with all bounds: {least:g}")
        return made

    def to_lists(self) -> list[Any]:
        """Return plain values for :meth:`from_lists`, exact to the last bit."""
        return [each.tolist() for each in (self.bounds, self.settings, self.table, self.shape)]

    @classmethod
    def from_lists(cls, lists: list[Any]) -> Self:
        """Undo :meth:`to_lists`."""
        return cls(*map(np.array, lists))

    def at_rest(self, input_um: float) -> F64:
        """Return the state of the plays at rest: float64[m - 1]."""
        u = (input_um - self.settings[kernel.MIDDLE_UM]) / self.settings[kernel.HALF_UM]
        return np.append(np.clip(0.0, u - self.thresholds, u + self.thresholds), u)

    def invert(self, input_um: F64, size: int, before: F64, after: F64, memory: F64) -> None:
        """Convert requested displacements to the model's input, in place."""
        kernel.adapted_input(input_um, size, before, after, self.constants, memory)

    def form(self, values: F64) -> F64:
        """Convert adapted parameters to o, g and w_i: float64[m]."""
        formed: F64 = self.shape.T @ values
        return formed

    @property
    def largest_um(self) -> float:
        """Largest error due to all parameters together, in um."""
        offset_um, shares = self.bounds[kernel.OFFSET], self.bounds[kernel.GAIN :].sum()
        return float(offset_um + 2.0 * shares * self.settings[kernel.HALF_UM])

    def _orthogonalise(self, reference_um: F64, told: tuple[slice, ...] | None) -> None:
        """Orthogonalise the regressors (Gram-Schmidt)."""
        m, n = self.bounds.size, 0
        sums, products, found = np.zeros(m), np.zeros((m, m)), np.zeros(m)
        memory = self.at_rest(float(reference_um[0:1][0]))
        for part in chunks(reference_um, told):
            n += part.size
            kernel.regressor_sums(
                np.array(part),  # a copy: compiled code refuses read-only arrays
                self.constants,
                memory,
                found,
                sums,
                products,
            )
        mean = sums / n
        self.table[kernel.CENTRE, kernel.GAIN :] = mean[kernel.GAIN :]
        products = products / n - np.outer(mean, mean)
        products[kernel.OFFSET, kernel.OFFSET] = 1.0
        for j in np.flatnonzero(self.bounds):
            before = np.arange(kernel.GAIN, j)
            if before.size:
                near = products[np.ix_(before, before)]
                ridge = _ALIKE * np.diag(np.diag(near))
                self.shape[j, before] = -np.linalg.solve(near + ridge, products[before, j])
            power = float(self.shape[j] @ products @ self.shape[j])
            self.table[kernel.POWER, j] = power + _RIDGE * products[j, j]

    def _least_slope(self) -> float:
        """Return the smallest slope of the operator within the bounds."""
        engaged = np.cumsum(self.shape[:, kernel.GAIN :], axis=1)
        return float(1.0 - (self.bounds @ np.abs(engaged)).max())


class Adaptation:
    """Adaptation of one run; called in every tick; it never blocks, and its output is finite.

    Args:
        time_constant_s: Time constant of the parameters, > 0.
        due_after: Delay from a reference to its displacement, in samples.
        shown_after: Delay from an input to its displacement, in samples.
        noise_um: Standard deviation of the sensor's noise; if None, :meth:`take_noise` sets it and
            starts the adaptation.
    """

    def __init__(
        self,
        operator: DisplacementOperator,
        time_constant_s: float,
        rate_hz: float,
        due_after: int,
        shown_after: int,
        noise_um: float | None,
    ) -> None:
        if not 0.0 < time_constant_s < math.inf:
            raise InputError(f"time_constant_s must be > 0: {time_constant_s}")
        m = operator.bounds.size
        self._operator = operator
        self._settings = operator.settings
        self._settings[kernel.LARGEST_UM] = operator.largest_um
        self._settings[kernel.RATE] = 1.0 / (time_constant_s * rate_hz)
        self._settings[kernel.SMOOTHING] = self._settings[kernel.RATE] / _SMOOTHED
        self._settings[kernel.LEAK] = _LEAK
        self._settings[kernel.COUNT] = max(1, int(np.count_nonzero(operator.bounds)))
        self._averaged = max(1.0, 2.0 / self._settings[kernel.SMOOTHING])
        due, shown = np.full(due_after + 1, np.nan), np.full(shown_after + 1, np.nan)
        self._lines = due, shown, np.zeros(2, dtype=np.int64)
        self._state = np.zeros((kernel.TOTAL + 1, m))
        self._before = np.zeros(m)
        self._fed: F64 | None = None
        self._seen: F64 | None = None
        self._event_after = math.ceil(_EVENT_S * rate_hz)
        ensure_compiled(kernel.adapted_input, kernel.adapt_block)
        self._said, self._said_at = np.zeros(m), 0
        self._ready = False
        if noise_um is not None:
            self.take_noise(noise_um)

    def take_noise(self, noise_um: float) -> None:
        """Set the dead zone from the noise's standard deviation, and start adapting.

        Only the first finite value counts.
        """
        if self._ready or not math.isfinite(noise_um):
            return
        self._ready = True
        self._settings[kernel.DEAD_UM2] = (_DEAD * noise_um) ** 2 / self._averaged

    @property
    def parameters(self) -> dict[str, float]:
        """Parameters of the operator by name, see :data:`hilctl.base.events.ADAPTED`.

        With v the model's output and ``offset_um`` less ``middle_um``, the displacement is
        ``middle_um`` + ``constant_um`` + ``direct`` v + sum ``weight_i`` P_i[v], and each play P_i
        has its ``threshold_um_i``.
        """
        operator, form = self._operator, self._state[kernel.FORM]
        offset_um, gain = self._state[kernel.VALUE, : kernel.WEIGHTS].tolist()
        constant_um = -float(form @ operator.table[kernel.CENTRE])
        found = {"offset_um": offset_um, "gain": 1.0 + gain, "constant_um": constant_um}
        found |= {"middle_um": float(self._settings[kernel.MIDDLE_UM])}
        found |= {"direct": 1.0 + float(form[kernel.GAIN])}
        half_um = float(self._settings[kernel.HALF_UM])
        for i, share in enumerate(THRESHOLDS, start=1):
            found[f"weight_{i}"] = float(form[kernel.GAIN + i])
            found[f"threshold_um_{i}"] = share * half_um
        return found

    def follow(self, input_um: F64, size: int) -> None:
        """Convert the input, float64[n], of a block of ``size`` samples to the model's input.

        The parameters change linearly over the block: a compensator with a lead would turn a step
        into a spike of the command.
        """
        if self._fed is None:
            self._fed = self._operator.at_rest(input_um.item(0))
            self._seen = self._fed.copy()
        self._operator.invert(input_um, size, self._before, self._state[kernel.FORM], self._fed)
        self._before[:] = self._state[kernel.FORM]

    def take(self, block: Block) -> None:
        """Adapt to an answered block, in any phase of the run.

        Samples with a flag (interlock, limiter, skipped ticks, ramp, conditioning) and
        displacements caused by their inputs are ignored.
        """
        if block.skipped:
            due, shown, _places = self._lines
            due[:] = shown[:] = np.nan
        if self._seen is None or not self._ready:
            return
        kernel.adapt_block(
            block.reference,
            block.input_um,
            block.displacement_um,
            block.flags,
            self._operator.constants,
            self._lines,
            self._seen,
            self._state,
        )

    def event(self, sample: int, *, ended: bool = False) -> Event | None:
        """Return an event with the parameters if they have changed enough or the run has ended."""
        values, bounds = self._state[kernel.VALUE], self._operator.bounds
        if not ended:
            if sample - self._said_at < self._event_after:
                return None
            self._said_at = sample
            if not (np.abs(values - self._said) > _EVENT_CHANGE * bounds).any():
                return None
        self._said[:] = values
        at_bound = (bounds > 0.0) & (np.abs(values) >= bounds)
        names = ["offset_um", "gain", *(f"weight_{i + 1}" for i in range(len(THRESHOLDS)))]
        held = ", ".join(name for name, there in zip(names, at_bound, strict=True) if there)
        text = adapted_text(self.parameters) + (f"; at its bound: {held}" if held else "")
        return Event(sample, "warning" if held else "info", ADAPTED, text, self.parameters)
