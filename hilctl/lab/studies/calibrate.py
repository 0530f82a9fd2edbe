"""Calibrate the sensor of a rig from a table, and its amplifier by small steps of the command."""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import date
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.polynomial import Polynomial

from hilctl.base.calibration import (
    GOOD_PERCENT,
    AmplifierCalibration,
    CalibrationFile,
    SensorCalibration,
)
from hilctl.base.errors import DataError, InputError, RunError
from hilctl.base.files import check_writable, exists, write_text
from hilctl.base.formatting import shown_briefly
from hilctl.base.strict import ValidationError, first_problem
from hilctl.base.table import Column, Table, open_table
from hilctl.base.types import F64, I64, CommandUnit
from hilctl.base.yaml import dump, load_document, setting
from hilctl.experiment.load import load_experiment
from hilctl.lab.studies.characterise.characterisation_runner import without_reference
from hilctl.lab.studies.study import Study, StudyStep
from hilctl.recording.recording import Recording
from hilctl.signals.cycle_metrics import rms

_HIGHEST_ORDER = 4
_BETTER = 1.1  # an order must lower the error of left-out points by this factor
_MUCH_BETTER = 2.0  # a table must lower the error of the best polynomial by this factor
_CHANCE = 1e-3  # probability of an outlier among points with normal noise
_MOST_OUTLIERS, _POINTS_PER_OUTLIER = 5, 7
_WORDS = {"reading": {"reading", "readings", "sensor", "indicated"},
          "true": {"true", "reference", "actual"}}  # fmt: skip
_PART = 0.1  # share of the way from the safe value to the limits
_STEPS = 11  # levels from one end to the other
_DWELL_S, _DWELL_SAMPLES = 0.4, 20


class Origin(NamedTuple):
    """Origin of a calibration."""

    date: date
    by: str  # operator
    reference: str  # reference instrument


@shown_briefly
@dataclass(frozen=True, slots=True)
class CalibrationFit:
    """A fitted calibration and its points.

    Attributes:
        x: Readings in um, or commands: float64[n].
        true: True displacements in um, or measured commands: float64[n].
        residuals: float64[n], true minus fitted values; of a table, errors of left-out points.
    """

    fitted: SensorCalibration | AmplifierCalibration
    x: F64
    true: F64
    residuals: F64

    def to_mapping(self) -> dict[str, Any]:
        """Return the calibration and its points as plain values."""
        points = {name: getattr(self, name).tolist() for name in ("x", "true", "residuals")}
        fitted = self.fitted.model_dump(mode="json", exclude_none=True)
        return {**fitted, "grade": self.fitted.grade, **points}


class SensorPoints(NamedTuple):
    """Points of a sensor, sorted by reading."""

    path: Path  # their table
    reading: F64  # um, float64[n]
    true: F64  # um, float64[n]
    lines: I64  # int64[n], their lines in the table


def sensor_points(path: Path, reading: Column | None, true: Column | None) -> SensorPoints:
    """Return the points in two columns of a table; None selects a column by its name.

    Raise DataError if a column is missing, unknown or not a length, or there are too few readings.
    """
    table = open_table(path)
    found = _columns(table, {"reading": reading, "true": true})
    for at in found:
        unit = table.unit(at)[0]
        if unit not in {"", "um"}:
            rule = f"column {table.names[at]} must be a length, got {unit}"
            raise DataError(f"{path}: {rule}: set the sensitivity and use readings in um")
    factors = np.array([[table.unit(at)[1]] for at in found])
    rows = table.read(found)
    values = rows.values * factors
    distinct = np.unique(values[0]).size
    if distinct < 3:
        raise DataError(f"{path}: must have at least 3 different readings, got {distinct}")
    order = np.argsort(values[0], kind="stable")
    return SensorPoints(path, values[0, order], values[1, order], rows.lines[order])


def _columns(table: Table, asked: dict[str, Column | None]) -> list[int]:
    found = []
    for quantity, column in asked.items():
        words = [set(re.findall("[a-z]+", name.lower())) for name in table.names]
        named = [at for at, each in enumerate(words) if each & _WORDS[quantity]]
        named = named if column is None else [table.index(column)]
        found += named if len(named) == 1 else []
    if len(set(found)) < len(asked):
        rule = "must have one column of readings and one of true displacements"
        cure = "set --reading-column and --true-column, by name or number"
        raise DataError(f"{table.path}: {rule}: {cure}; its columns are {table.listed}")
    return found


def fit_sensor(points: SensorPoints, origin: Origin) -> CalibrationFit:
    """Fit the curve of a sensor: the lowest order that the noise supports, or else a table.

    Raise DataError if points are outliers, or the fitted displacement does not rise with the
    reading, or rises by a very different amount.
    """
    path, reading, true, _ = points
    if found := _outliers(points):
        raise DataError("\n".join(found))
    curve = _curve(reading, true, _order(reading, true))
    points_um = np.stack(_averaged(reading, true), axis=1)
    shape: dict[str, Any] = {"table": tuple(map(tuple, points_um.tolist()))}
    if curve.polynomial is not None:
        shape = {"polynomial": tuple(curve.polynomial.convert().coef.tolist())}
    try:
        fitted = SensorCalibration(
            **origin._asdict(),
            range_um=(float(reading[0]), float(reading[-1])),
            residual_rms=float(np.sqrt(np.sum(curve.residuals**2) / curve.freedom)),
            residual_max=float(np.abs(curve.residuals).max()),
            **shape,
        )
    except ValidationError as error:
        raise DataError(first_problem(error, str(path))) from None
    return CalibrationFit(fitted, curve.x, curve.y, curve.residuals)


class _Curve(NamedTuple):
    """A polynomial or a table of points (None), with its errors at points, float64[n]."""

    polynomial: Polynomial | None
    x: F64
    y: F64
    residuals: F64
    left_out: F64  # error of each point if it is omitted
    freedom: int  # of the residuals


def _curve(x: F64, y: F64, order: int) -> _Curve:
    """Return the polynomial of an order, or of order 0 the table of points without its ends."""
    if order == 0:
        knots, mean = _averaged(x, y)
        share = (knots[1:-1] - knots[:-2]) / (knots[2:] - knots[:-2])  # between the neighbours
        left_out = mean[1:-1] - (mean[:-2] + share * (mean[2:] - mean[:-2]))
        return _Curve(None, knots[1:-1], mean[1:-1], left_out, left_out, left_out.size)
    curve = Polynomial.fit(x, y, order)
    start, scale = curve.mapparms()
    basis = np.polynomial.polynomial.polyvander(start + scale * x, order)
    leverage = (np.linalg.qr(basis).Q ** 2).sum(axis=1)
    residuals = y - curve(x)
    return _Curve(curve, x, y, residuals, residuals / (1.0 - leverage), x.size - order - 1)


def _order(x: F64, y: F64) -> int:
    """Return the lowest order that the noise supports, 0 if a table is much better."""
    orders = range(1, min(_HIGHEST_ORDER, np.unique(x).size - 2) + 1)
    left_out = [_curve(x, y, order).left_out for order in orders]
    rounding = 1e-9 * float(np.ptp(y))  # must not count as noise of exact points
    inner = (x > x[0]) & (x < x[-1])  # a table has no error at its ends
    best_inside = min(rms(each[inner]) for each in left_out)
    if _MUCH_BETTER * rms(_curve(x, y, 0).left_out) + rounding < best_inside:
        return 0
    errors = [rms(each) for each in left_out]
    enough = _BETTER * min(errors) + rounding
    return next(order for order, error in zip(orders, errors, strict=True) if error <= enough)


def _outliers(points: SensorPoints) -> list[str]:
    """Return a message for each point that the noise of the others does not explain.

    Points are removed one by one, so that several do not hide each other (generalized ESD test).
    """
    from scipy.special import stdtr

    path, x, y, lines = points
    smallest_um = 0.01 * GOOD_PERCENT * float(np.ptp(x))
    kept = np.ones(x.size, dtype=bool)
    removed: list[str] = []
    count = 0
    for _ in range(min(_MOST_OUTLIERS, x.size // _POINTS_PER_OUTLIER)):
        order = _order(x[kept], y[kept])
        curve = _curve(x[kept], y[kept], order)
        at = int(np.abs(curve.left_out).argmax())
        error_um = abs(float(curve.left_out[at]))
        if error_um < smallest_um or curve.freedom < 3 or np.unique(x[kept]).size < 4:
            break
        expected = curve.y[at] - curve.left_out[at]
        row = int(np.where(kept & (x == curve.x[at]), np.abs(y - expected), -1.0).argmax())
        point = f"{path}:{lines[row]}: true {y[row]:g} µm at a reading of {x[row]:g} µm"
        error = f"is {y[row] - expected:+.3g} µm from the curve of the other points"
        removed.append(f"{point} {error}: correct it, or delete the row")
        kept[row] = False
        others = _curve(x[kept], y[kept], order)
        left = float(np.sum(others.residuals**2))
        gained = max(float(np.sum(curve.residuals**2)) - left, 0.0)
        variance = max(left / others.freedom, 1e-300)
        t = np.sqrt(min(gained, error_um**2) / variance)
        if 2.0 * curve.x.size * stdtr(others.freedom, -t) < _CHANCE:
            count = len(removed)
    return removed[:count]


def _averaged(x: F64, y: F64) -> tuple[F64, F64]:
    """Return the distinct values of ``x``, and the mean of ``y`` at each."""
    knots, at = np.unique(x, return_inverse=True)
    return knots, np.bincount(at, y) / np.bincount(at)


def measure_amplifier(
    experiment: Path, settings: Sequence[str], name: str, origin: Origin
) -> Study[CalibrationFit]:
    """Step the command within a tenth of its limits, and fit gain and offset of its read-back.

    Raise InputError if the experiment is invalid, or its device does not measure; nothing has
    moved. Raise RunError if the run ended early.
    """
    settings = [*without_reference(experiment, settings), "condition=null"]
    loaded = load_experiment(experiment, settings)
    if loaded.document.holds(("device", "calibration")):
        settings.append("device.calibration=null")
    if not loaded.device.info.measures_command:
        raise InputError(f"{experiment}: device.measure: is required, to read the command back")
    config, unit = loaded.config, loaded.config.limits.unit
    safe, rate_hz = config.safe.value, config.sample_rate_hz
    low, high = (safe + _PART * (end - safe) for end in config.limits.command_range)
    rising = np.linspace(low, high, _STEPS)
    levels = np.concatenate((rising, rising[-2::-1]))
    rise = 2.0 * (high - low) / config.limits.slew_per_s * rate_hz
    dwell = int(max(2.0 * rise, _DWELL_S * rate_hz, _DWELL_SAMPLES))
    steps = {"kind": "step", "unit": unit, "levels": levels.tolist(), "rest": safe}
    times = {"dwell_s": dwell / rate_hz, "rise_s": 0.5 * dwell / rate_hz}
    run = yield StudyStep(experiment, [*settings, setting("waveform", steps | times)], name)
    command, measured = _settled_means(run.recording, dwell, levels.size)
    return _amplifier_fit(run.path, command, measured, (low, high), unit, origin)


def _settled_means(recorded: Recording, dwell: int, levels: int) -> tuple[F64, F64]:
    """Return the mean command and its read-back at the end of each step: float64[levels] each."""
    start = recorded.segments[0].start
    samples = recorded.samples.part(start, start + dwell * levels)
    settled = (samples.index - start) % dwell >= 0.6 * dwell
    step = (samples.index[settled] - start) // dwell
    count = np.maximum(np.bincount(step, minlength=levels), 1)
    command, measured = (
        np.bincount(step, values[settled], levels) / count
        for values in (samples.command, samples.measured)
    )
    return command, measured


def _amplifier_fit(
    path: Path,
    command: F64,
    measured: F64,
    span: tuple[float, float],
    unit: CommandUnit,
    origin: Origin,
) -> CalibrationFit:
    """Fit gain and offset of a read-back; raise RunError if it does not follow the command."""
    centred = command - command.mean()
    gain = float(centred @ measured / (centred @ centred))
    offset = float(measured.mean() - gain * command.mean())
    residuals = measured - (gain * command + offset)
    try:
        fitted = AmplifierCalibration(
            **origin._asdict(),
            unit=unit,
            range=span,
            gain=gain,
            offset=offset,
            residual_rms=float(np.sqrt(np.sum(residuals**2) / (command.size - 2))),
            residual_max=float(np.abs(residuals).max()),
        )
    except ValidationError:
        line = f"{gain:.3g} * command {offset:+.3g} {unit}"
        hint = "Check device.amplifier, device.measure and their wiring"
        raise RunError(f"{path}: the read-back is not the command: {line}. {hint}") from None
    return CalibrationFit(fitted, command, measured, residuals)


def existing_calibration(path: Path, part: str, *, overwrite: bool) -> CalibrationFile | None:
    """Return the calibration in the file to write, None without one.

    Raise InputError if it has this calibration already, is no calibration, or cannot be written.
    """
    if not exists(path):
        check_writable(path, overwrite=overwrite)
        return None
    before = load_document(path).validate(CalibrationFile)
    check_writable(path, overwrite=overwrite or getattr(before, part) is None)
    return before


def write_calibration(
    path: Path, fitted: SensorCalibration | AmplifierCalibration, before: CalibrationFile | None
) -> None:
    """Write a calibration file, and keep the other calibration of an existing one."""
    part = "sensor" if isinstance(fitted, SensorCalibration) else "amplifier"
    kept = {} if before is None else before.parts
    written = CalibrationFile.model_validate(kept | {part: fitted})
    text = dump(written.model_dump(mode="json", exclude_none=True))
    write_text(path, text, overwrite=before is not None)
