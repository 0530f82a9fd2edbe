"""Calibrate the sensor of a rig from a table, and its amplifier by small steps of the command."""

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import date
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.polynomial import Polynomial

from hilctl.base.calibration import (
    AmplifierCalibration,
    CalibrationFile,
    SensorCalibration,
)
from hilctl.base.errors import DataError, InputError, RunError
from hilctl.base.files import check_writable, exists, write_text
from hilctl.base.formatting import shown_briefly
from hilctl.base.strict import ValidationError, first_problem
from hilctl.base.table import Column, open_table
from hilctl.base.types import F64
from hilctl.base.yaml import dump, load_document
from hilctl.experiment.load import load_experiment
from hilctl.recording.reader import read
from hilctl.signals.cycle_metrics import rms
from hilctl.studies.characterise.characterisation_runner import without_reference
from hilctl.studies.step_runner import StudyHost, raise_if_stopped, setting

_HIGHEST_ORDER = 4
_BETTER = 1.1  # an order must lower the error of left-out points by this factor
_MUCH_BETTER = 2.0  # and a table that of the best polynomial
_PART = 0.1  # of the way from the safe value to the limits
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
        return {**self.fitted.model_dump(mode="json", exclude_none=True), **points}


def sensor_points(path: Path, columns: tuple[Column, Column]) -> tuple[F64, F64]:
    """Return reading and true displacement of each row of a table, in um, by rising reading.

    Raise DataError if a column is missing or not a length, or there are too few readings.
    """
    table = open_table(path)
    found = [table.index(column) for column in columns]
    for at in found:
        unit = table.unit(at)[0]
        if unit not in {"", "um"}:
            rule = f"column {table.names[at]} must be a length, got {unit}"
            raise DataError(f"{path}: {rule}: set the sensitivity and use readings in um")
    factors = np.array([[table.unit(at)[1]] for at in found])
    reading, true = table.read(found).values * factors
    distinct = np.unique(reading).size
    if distinct < 3:
        raise DataError(f"{path}: must have at least 3 different readings, got {distinct}")
    order = np.argsort(reading, kind="stable")
    return reading[order], true[order]


def fit_sensor(name: str, reading: F64, true: F64, origin: Origin) -> CalibrationFit:
    """Fit the curve of a sensor: the lowest order that the noise supports, or else a table.

    Readings rise; both are float64[n], in um. ``name`` is that of the data in messages. Raise
    DataError if the fitted displacement does not rise with the reading, or not as far.
    """
    fits = [
        _polynomial(reading, true, order)
        for order in range(1, min(_HIGHEST_ORDER, np.unique(reading).size - 2) + 1)
    ]
    errors = [rms(left_out) for _, left_out in fits]
    # Rounding errors of exact points must not count as noise.
    enough = _BETTER * min(errors) + 1e-9 * float(np.ptp(true))
    curve, _ = fits[next(order for order, error in enumerate(errors) if error <= enough)]
    residuals, freedom = true - curve(reading), reading.size - curve.coef.size
    shape: dict[str, Any] = {"polynomial": tuple(curve.convert().coef.tolist())}
    knots, mean = _averaged(reading, true)
    share = (knots[1:-1] - knots[:-2]) / (knots[2:] - knots[:-2])  # between the neighbours
    left_out = mean[1:-1] - (mean[:-2] + share * (mean[2:] - mean[:-2]))
    if _MUCH_BETTER * rms(left_out) + 1e-9 * float(np.ptp(true)) < min(errors):
        shape = {"table": tuple(zip(knots.tolist(), mean.tolist(), strict=True))}
        reading, true, residuals, freedom = knots[1:-1], mean[1:-1], left_out, left_out.size
    try:
        fitted = SensorCalibration(
            **origin._asdict(),
            range_um=(float(knots[0]), float(knots[-1])),
            residual_rms=float(np.sqrt(np.sum(residuals**2) / freedom)),
            residual_max=float(np.abs(residuals).max()),
            **shape,
        )
    except ValidationError as error:
        raise DataError(first_problem(error, name)) from None
    return CalibrationFit(fitted, reading, true, residuals)


def _polynomial(x: F64, y: F64, order: int) -> tuple[Polynomial, F64]:
    """Return the polynomial of an order, and the error of each point if it is left out."""
    curve = Polynomial.fit(x, y, order)
    start, scale = curve.mapparms()
    basis = np.polynomial.polynomial.polyvander(start + scale * x, order)
    leverage = (np.linalg.qr(basis).Q ** 2).sum(axis=1)
    return curve, (y - curve(x)) / (1.0 - leverage)


def _averaged(x: F64, y: F64) -> tuple[F64, F64]:
    """Return the distinct values of ``x``, and the mean of ``y`` at each."""
    knots, at = np.unique(x, return_inverse=True)
    return knots, np.bincount(at, y) / np.bincount(at)


def measure_amplifier(
    experiment: Path,
    settings: Sequence[str],
    recording: Path,
    origin: Origin,
    host: StudyHost,
) -> CalibrationFit:
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
    result = host.run(
        experiment,
        [*settings, setting("waveform", steps | times)],
        recording,
        lambda part: host.on_progress(part, "steps"),
        overwrite=False,
    )
    raise_if_stopped("calibrate", result)
    if result.code != "completed":
        raise RunError(f"{recording}: {result.reason}")
    recorded = read(recording)
    start = recorded.segments[0].start
    samples = recorded.samples.part(start, start + dwell * levels.size)
    settled = (samples.index - start) % dwell >= 0.6 * dwell
    step = (samples.index[settled] - start) // dwell
    count = np.maximum(np.bincount(step, minlength=levels.size), 1)
    command, measured = (
        np.bincount(step, values[settled], levels.size) / count
        for values in (samples.command, samples.measured)
    )
    centred = command - command.mean()
    gain = float(centred @ measured / (centred @ centred))
    offset = float(measured.mean() - gain * command.mean())
    residuals = measured - (gain * command + offset)
    try:
        fitted = AmplifierCalibration(
            **origin._asdict(),
            unit=unit,
            range=(low, high),
            gain=gain,
            offset=offset,
            residual_rms=float(np.sqrt(np.sum(residuals**2) / (levels.size - 2))),
            residual_max=float(np.abs(residuals).max()),
        )
    except ValidationError:
        line = f"{gain:.3g} * command {offset:+.3g} {unit}"
        hint = "Check device.amplifier, device.measure and their wiring"
        raise RunError(f"{recording}: the read-back is not the command: {line}. {hint}") from None
    return CalibrationFit(fitted, command, measured, residuals)


def existing_calibration(path: Path, part: str, *, overwrite: bool) -> CalibrationFile | None:
    """Return the calibration in the file to write, None without one.

    Raise InputError if it has this part already, is something else, or cannot be written.
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
    """Write a calibration file, with the other part of the file before."""
    part = "sensor" if isinstance(fitted, SensorCalibration) else "amplifier"
    kept = {} if before is None else {name: getattr(before, name) for name in before.dates}
    written = CalibrationFile(**kept | {part: fitted}).model_dump(mode="json", exclude_none=True)
    write_text(path, dump(written), overwrite=before is not None)
