"""What a model file says of how its model was found."""

import numpy as np
import scipy

import hilctl
from hilctl.identify.data import Loop, Record
from hilctl.identify.fit import Judgement
from hilctl.identify.settings import Kind, Settings

EQUATIONS: dict[Kind, str] = {
    "ppi": "PPI (3.25-3.27)",
    "rdpi": "RDPI (5.11, 5.14)",
    "integrated": "integrated model (6.18-6.24), g_0 fixed to 1",
    "staged": "integrated model (6.5) between stages, g_0 fixed to 1",
}


def method(kind: Kind, settings: Settings) -> str:
    """Return the choices of a fit in one line."""
    parts = [
        f"{EQUATIONS[kind]}: {settings.plays} plays",
        f"{settings.weights} weights",
        f"{settings.layout} thresholds",
        f"least squares, loops weighted {settings.weight_by}",
        f"{settings.starts} starts",
        f"slopes at least {settings.least_slope:g} of the mean",
    ]
    if kind in {"integrated", "staged"}:
        parts.insert(1, f"{2 * settings.deadbands_a_side + 1} deadbands")
    if kind == "staged":
        lag = {"growth": "lag that grows", "plain": "lag", "none": "no lag"}[settings.lag]
        parts += [lag, "structure" if settings.structure else "no structure"]
        parts.append("delay fitted" if settings.delay else "no delay but the loop's")
        if settings.hysteresis == "preisach":
            parts.append(f"then a Preisach triangle of {settings.lines} lines in place of both")
    if settings.output_offset:
        parts.append("constant displacement fitted")
    if settings.creep:
        parts.append("constant displacement and creep of each record fitted beside it")
    if settings.peak_goal_percent is not None:
        parts.append(f"then reweighted for a peak error of {settings.peak_goal_percent:g} %")
    return ", ".join(parts)


def grid_line(record: Record) -> str:
    """Return what one record holds in one line."""
    command = record.command
    low, high = float(command.min()), float(command.max())
    points = f"{command.size} points at "
    if isinstance(record, Loop):
        points += f"{record.frequency_hz:g} Hz"
    else:
        points = f"{command.size} samples at {record.sample_rate_hz:g} Hz"
        points += f", first {record.ignore} ignored"
    return f"{record.label}: {low:.4g} to {high:.4g}, {points}"


def error_table(judgement: Judgement) -> dict[str, float]:
    """Return the errors by name."""
    areas = [error.area_error_percent for error in judgement.errors]
    table = {
        "peak": judgement.peak_percent,
        "rms": judgement.rms_percent,
        "own_peak": judgement.own_peak_percent,
    }
    known = [abs(area) for area in areas if area is not None]
    return table | ({"area": max(known)} if known else {})


def versions() -> dict[str, str]:
    """Return the versions of the software that a fit rests on."""
    return {"hilctl": hilctl.__version__, "numpy": np.__version__, "scipy": scipy.__version__}
