"""How many plays and deadbands the data bear, and by how many samples they lag."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from hilctl.base.errors import DataError
from hilctl.identify.data.records import Record, Records
from hilctl.identify.evaluation import judge
from hilctl.identify.fit_api import OnProgress
from hilctl.identify.fit_model import fit_model
from hilctl.identify.parallel import MapFunction
from hilctl.identify.settings import FitSettings

ORDERS = ((6, 4), (8, 6), (12, 8), (16, 10), (20, 12), (28, 16))
"""Plays, and deadbands on each side where the model has any."""
LINES = (8, 12, 16, 20, 28, 36)
"""Lines of a Preisach triangle, in the place of :data:`ORDERS`."""
FOLDS = 4
WORTH = 1.03  # a larger model must lower the error by more than 3 %
MOST_LAG = 8  # samples tried


@dataclass(frozen=True, slots=True)
class OrderScore:
    """How a model of one size did on loops that it was not fitted to.

    Attributes:
        plays: Play operators; lines, where the model has a Preisach triangle.
        deadbands_a_side: Deadbands on each side of 0.
        rms_percent: Of all loops, each held out once, in percent of the largest peak-to-peak.
        peak_percent: The same for the largest error.
    """

    plays: int
    deadbands_a_side: int
    rms_percent: float
    peak_percent: float


@dataclass(frozen=True, slots=True)
class _HeldOut:
    settings: FitSettings
    fitted: tuple[Record, ...]
    held_out: tuple[Record, ...]


def choose_order(
    data: Records, settings: FitSettings, run: MapFunction, progress: OnProgress
) -> tuple[FitSettings, tuple[OrderScore, ...]]:
    """Find the smallest model whose error on loops that it did not see is near the least.

    Every loop is held out once, a quarter of them at a time.

    Args:
        data: Four loops or more.
        settings: All other choices.
        run: Runs fits that do not depend on each other.
        progress: Called with what is being done.

    Returns:
        The settings with that order, and what every order did.

    Raises:
        DataError: There are too few loops.
    """
    if len(data) < FOLDS:
        raise DataError(
            f"choosing the number of plays holds out a quarter of the loops: needs at least "
            f"{FOLDS}, got {len(data)}"
        )
    tried = _tried(settings.model_copy(update={"starts": 1}))
    trials = [_trial(each, data, fold) for each in tried for fold in range(FOLDS)]
    progress(0.0, f"{len(trials)} fits for the number of plays")
    sums = np.array(run(_errors, trials)).reshape(len(tried), FOLDS, 3)
    rms_um = np.sqrt(sums[:, :, 0].sum(axis=1) / sums[:, :, 1].sum(axis=1))
    stroke_um = max(float(np.ptp(record.displacement_um)) for record in data)
    to_percent = 100.0 / stroke_um
    errors = tuple(
        OrderScore(*_order(each), float(rms) * to_percent, float(peak))
        for each, rms, peak in zip(
            tried, rms_um, sums[:, :, 2].max(axis=1) * to_percent, strict=True
        )
    )
    best = int(np.argmax(rms_um <= WORTH * rms_um.min()))
    chosen = tried[best]
    return chosen.model_copy(update={"starts": settings.starts}), errors


def _tried(settings: FitSettings) -> list[FitSettings]:
    if settings.hysteresis == "preisach":
        return [settings.model_copy(update={"lines": lines}) for lines in LINES]
    return [settings.model_copy(update={"plays": n, "deadbands": k}) for n, k in ORDERS]


def _order(settings: FitSettings) -> tuple[int, int]:
    if settings.hysteresis == "preisach":
        return settings.lines, 0
    return settings.plays, settings.deadbands if settings.has("deadbands") else 0


def choose_lag(
    load: Callable[[int], Records], settings: FitSettings, run: MapFunction, progress: OnProgress
) -> int:
    """Find by how many samples the displacement lags: the lag that leaves the least error.

    Args:
        load: Gives the data with the displacement taken that many samples earlier.
        settings: The choices of the fit.
        run: Runs fits that do not depend on each other.
        progress: Called with what is being done.
    """
    progress(0.0, f"{MOST_LAG + 1} fits for the lag of the displacement")
    lean = settings.model_copy(update={"starts": 1, "peak_goal_percent": None})
    loaded = [tuple(load(lag)) for lag in range(MOST_LAG + 1)]
    sums = np.array(run(_errors, [_HeldOut(lean, data, data) for data in loaded]))
    return int(np.argmin(sums[:, 0] / sums[:, 1]))


def _trial(settings: FitSettings, data: Sequence[Record], fold: int) -> _HeldOut:
    fitted = tuple(record for i, record in enumerate(data) if i % FOLDS != fold)
    return _HeldOut(settings, fitted, tuple(data[fold::FOLDS]))


def _errors(trial: _HeldOut) -> tuple[float, float, float]:
    """Return the sum of squares in um^2, the samples, and the largest error in um."""
    found = fit_model(trial.fitted, trial.settings, lambda: 0.0)
    judged = judge(found.model, trial.held_out, creep=trial.settings.creep)
    stroke_um = max(error.peak_to_peak_um for error in judged.errors)
    samples = sum(response.size for response in judged.modelled_um)
    squares = samples * (judged.rms_percent * stroke_um / 100.0) ** 2
    return squares, float(samples), judged.peak_percent * stroke_um / 100.0
