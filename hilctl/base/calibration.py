"""Calibration files: the curve of a sensor, gain and offset of an amplifier, with their origin.

A curve is a table of points, so that readings are interpolated and never extrapolated.
"""

from dataclasses import dataclass
from datetime import date
from typing import Annotated, Literal, Self, TypeAlias

import numpy as np

from hilctl.base.errors import InputError
from hilctl.base.strict import BeforeValidator, Field, StrictModel, model_validator
from hilctl.base.types import F64, CommandUnit

_POINTS = 1025  # points of a polynomial: the error is below 1e-6 of the range
_LEAST_RATIO, _MOST_RATIO = 0.5, 2.0  # beyond, a unit or a sensitivity is wrong
GOOD_PERCENT, USABLE_PERCENT = 0.5, 2.0  # largest residual, of the calibrated range


def _date(value: object) -> date:
    if isinstance(value, date):
        return value
    try:
        return date.fromisoformat(value if isinstance(value, str) else "")
    except ValueError:
        raise ValueError("must be a date, such as 2026-01-31") from None


CalibrationDate: TypeAlias = Annotated[date, BeforeValidator(_date)]


class CalibrationOrigin(StrictModel):
    """Origin of a calibration, and its residuals.

    Attributes:
        by: Operator.
        reference: Reference instrument.
        residual_rms: Root mean square of the residuals, in the unit of the calibrated quantity.
        residual_max: Largest absolute residual.
    """

    date: CalibrationDate
    by: str
    reference: str
    residual_rms: Annotated[float, Field(ge=0.0)]
    residual_max: Annotated[float, Field(ge=0.0)]

    @property
    def ends(self) -> tuple[float, float]:
        """Lowest and highest calibrated reading or command."""
        raise NotImplementedError

    @property
    def residual_percent(self) -> float:
        """Largest residual in percent of the calibrated range."""
        return 100.0 * self.residual_max / (self.ends[1] - self.ends[0])

    @property
    def grade(self) -> Literal["good", "usable", "poor"]:
        """Grade of the largest residual."""
        if self.residual_percent > USABLE_PERCENT:
            return "poor"
        return "good" if self.residual_percent <= GOOD_PERCENT else "usable"


class SensorCalibration(CalibrationOrigin):
    """True displacement as a function of the sensor's reading, both in um.

    Attributes:
        range_um: Lowest and highest calibrated reading.
        polynomial: Coefficients of the true displacement, from the constant on.
        table: Reading and true displacement of each point; instead of ``polynomial``.
    """

    range_um: tuple[float, float]
    polynomial: Annotated[tuple[float, ...], Field(min_length=2, max_length=5)] | None = None
    table: Annotated[tuple[tuple[float, float], ...], Field(min_length=2)] | None = None

    @model_validator(mode="after")
    @np.errstate(over="ignore", invalid="ignore")  # refused here
    def _rises(self) -> Self:
        if (self.polynomial is None) == (self.table is None):
            raise ValueError("must have one of polynomial and table")
        low, high = self.range_um
        first, last = (self.table[0][0], self.table[-1][0]) if self.table else (low, high)
        if not first <= low < high <= last:
            inside = f" within the table's readings, {first:g} to {last:g}" if self.table else ""
            raise ValueError(f"range_um must rise{inside}, got [{low:g}, {high:g}]")
        for name, values in zip(("readings", "displacements"), self.points, strict=True):
            if not (np.isfinite(values).all() and (np.diff(values) > 0.0).all()):
                rule = "if they fall, reverse the sign of device.sensor"
                raise ValueError(
                    f"{'table' if self.table else 'polynomial'}: {name} must rise in "
                    f"range_um ({rule})"
                )
        ends = np.interp(self.range_um, *self.points)
        if not _LEAST_RATIO <= (ratio := float(np.ptp(ends)) / (high - low)) <= _MOST_RATIO:
            span = f"{_LEAST_RATIO:g} to {_MOST_RATIO:g}"
            raise ValueError(
                f"the true displacement must span {span} times the readings in range_um, got "
                f"{ratio:.3g} (check the columns, use um for both, or correct device.sensor)"
            )
        return self

    @property
    def ends(self) -> tuple[float, float]:
        """Lowest and highest calibrated reading in um."""
        return self.range_um

    @property
    def points(self) -> tuple[F64, F64]:
        """Reading and true displacement at points of the curve, float64[n] each."""
        if self.table is not None:
            reading, true = np.array(self.table).T
            return reading, true
        reading = np.linspace(*self.range_um, _POINTS)
        return reading, np.polynomial.Polynomial(self.polynomial or ())(reading)

    def curve(self, low_um: float, high_um: float) -> tuple[F64, F64]:
        """Return the points of the curve for a sensor that reads from ``low_um`` to ``high_um``.

        Raise InputError if this range and the calibrated one do not overlap.
        """
        low, high = max(low_um, self.range_um[0]), min(high_um, self.range_um[1])
        if not low < high:
            span = f"{low_um:g} to {high_um:g} um"
            raise InputError(f"calibration: range_um must overlap the sensor's range, {span}")
        reading, true = self.points
        inner = reading[(low < reading) & (reading < high)]
        kept = np.concatenate(([low], inner, [high]))
        return kept, np.interp(kept, reading, true)


class AmplifierCalibration(CalibrationOrigin):
    """The actual command is ``gain * command + offset``.

    A line far from the identity means a wrong read-back, which would drive the actuator too far.

    Attributes:
        range: Lowest and highest command of the calibration.
    """

    unit: CommandUnit
    range: tuple[float, float]
    gain: Annotated[float, Field(ge=0.8, le=1.25)]
    offset: float

    @model_validator(mode="after")
    def _is_plausible(self) -> Self:
        low, high = self.range
        if not low < high:
            raise ValueError(f"range must rise, got [{low:g}, {high:g}]")
        if not abs(self.offset) <= high - low:
            raise ValueError(f"offset must be at most the width of the range, {high - low:g}")
        return self

    @property
    def ends(self) -> tuple[float, float]:
        """Lowest and highest command of the calibration."""
        return self.range


class CalibrationFile(StrictModel):
    """Content of a calibration file."""

    sensor: SensorCalibration | None = None
    amplifier: AmplifierCalibration | None = None

    @model_validator(mode="after")
    def _something(self) -> Self:
        if self.sensor is None and self.amplifier is None:
            raise ValueError("must have a sensor or an amplifier")
        return self

    @property
    def parts(self) -> dict[str, SensorCalibration | AmplifierCalibration]:
        """The calibrations by their keys."""
        both = {"sensor": self.sensor, "amplifier": self.amplifier}
        return {name: each for name, each in both.items() if each is not None}


@dataclass(frozen=True, slots=True)
class NamedCalibration:
    """A calibration file, its text, and its path in the experiment."""

    name: str
    content: CalibrationFile
    text: str
