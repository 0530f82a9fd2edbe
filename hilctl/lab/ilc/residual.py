"""Residual error after learning: its frequencies, and what prevents their correction."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from hilctl.lab.ilc.cycle import CycleScore
from hilctl.lab.ilc.update import AT_FLOOR, IlcIteration, IlcState, measured_response

CAUSES = {
    "outside": "outside of the bandwidth of corrections",
    "not_repeatable": "not repeatable: the same correction has another error in another run",
    "limit": "larger corrections would exceed a limit",
    "unfinished": "learning ended too early: allow more cycles",
    "uncertain": "response uncertain: its phase varies, or its changes are within the noise",
    "coupled": "changes with the corrections of other frequencies",
    "noise": "within the noise: average more cycles",
}
"""What prevents the correction of a frequency."""

_CLEAR = 3.0  # standard deviations
_CERTAIN = 0.5
"""Largest doubt of a known response, as a share of it: 30 degrees."""

_MATTERS = 0.1
"""Smallest share of a band in the power of all, and of all in that of the error."""

_ANOTHER = 0.5
"""Smallest change of a harmonic from run to run that prevents its correction, as a share of it."""

_ADJACENT = 3  # harmonics


@dataclass(frozen=True, slots=True)
class ResidualBand:
    """Neighbouring harmonics of the residual error with one cause.

    Attributes:
        rms_percent: Their rms error, in percent of the reference's peak-to-peak.
        cause: A key of :data:`CAUSES`.
    """

    low_hz: float
    high_hz: float
    rms_percent: float
    cause: str

    def __str__(self) -> str:
        ends = dict.fromkeys((f"{self.low_hz:.4g}", f"{self.high_hz:.4g}"))
        return f"{' to '.join(ends)} Hz ({self.rms_percent:.2g} % rms): {CAUSES[self.cause]}"


def residual(state: IlcState, best: IlcIteration, check: CycleScore | None) -> list[ResidualBand]:
    """Return the bands of the error that remains with the best correction; none at the noise floor.

    ``check`` is the error of another run with that correction, if there is one. If only that one is
    above the floor, the bands are those that do not repeat.
    """
    error = check or best.error
    if _is_at_floor(error):
        return []
    size = np.abs(error.harmonics_um)
    power = np.where(np.arange(size.size) > 0, 2.0, 1.0) * size**2
    causes = _causes(state, best, check)
    bands = [
        ResidualBand(
            k[0] * error.step_hz, k[-1] * error.step_hz, _percent(power[k].sum(), error),
            causes[k[0]],
        )
        for k in _groups(np.flatnonzero(size > _CLEAR * error.noise_um).tolist(), causes)
    ]  # fmt: skip
    # The average cycle has more harmonics than a correction, with white noise.
    beyond = error.rms_um**2 - float(power.sum())
    half = 0.5 * state.sample_rate_hz
    white = 2.0 * float(np.mean(error.noise_um[1:] ** 2)) * (half / error.step_hz - size.size)
    if beyond > _CLEAR * white:
        low_hz = size.size * error.step_hz
        bands.append(ResidualBand(low_hz, half, _percent(beyond - white, error), "outside"))
    if at_floor := _is_at_floor(best.error):
        bands = [band for band in bands if band.cause == "not_repeatable"]
    total = sum(band.rms_percent**2 for band in bands)
    rms_percent = _percent(error.rms_um**2, error)
    if total < _MATTERS * rms_percent**2:
        return [] if at_floor else [ResidualBand(0.0, half, rms_percent, "noise")]
    return [band for band in bands if band.rms_percent**2 >= _MATTERS * total]


def _is_at_floor(error: CycleScore) -> bool:
    return error.peak_um <= AT_FLOOR * error.floor_um


def _percent(power: float, error: CycleScore) -> float:
    return 100.0 * float(np.sqrt(power)) / error.peak_to_peak_um


def _causes(state: IlcState, best: IlcIteration, check: CycleScore | None) -> list[str]:
    """Return what prevents the correction of each harmonic."""
    response, doubt = measured_response(state)
    frequency = np.arange(response.size) * best.error.step_hz
    certain = (doubt < _CERTAIN * np.abs(response)) & (frequency <= state.reach_hz)
    rest = "limit" if state.limited else "" if state.done else "unfinished"
    causes = [rest or ("coupled" if known else "uncertain") for known in certain]
    if check is not None:
        changed_um = np.abs(check.harmonics_um - best.error.harmonics_um)
        clear_um = _CLEAR * np.hypot(check.noise_um, best.error.noise_um)
        other = changed_um > np.maximum(clear_um, _ANOTHER * np.abs(check.harmonics_um))
        for k in np.flatnonzero(other):
            causes[k] = "not_repeatable"
    return causes


def _groups(harmonics: Sequence[int], causes: Sequence[str]) -> list[list[int]]:
    """Return adjacent harmonics with the same cause."""
    groups: list[list[int]] = []
    for k in harmonics:
        last = groups[-1][-1] if groups else -math.inf
        if k - last <= _ADJACENT and causes[k] == causes[groups[-1][-1]]:
            groups[-1].append(k)
        else:
            groups.append([k])
    return groups
