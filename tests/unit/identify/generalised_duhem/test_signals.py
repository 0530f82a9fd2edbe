"""Stages in a row, and the field and displacement that they leave of a record."""

import numpy as np
import pytest

from hilctl.identify.data.records import History
from hilctl.identify.field.prepared import OFF, Prepared
from hilctl.identify.field.stages import HIGH, LOW, STEP
from hilctl.identify.generalised_duhem.fits import POINTS
from hilctl.identify.generalised_duhem.signals import (
    FIRST,
    HIGHEST,
    LOWEST,
    NAMES,
    STAGES,
    STEPS,
    Signals,
)
from tests.unit.identify.generalised_duhem.test_fits import RATE_HZ, command, truth


def data(unit: float = 1.0, um: float = 1.0) -> Prepared:
    """Return a record in other units of the command and the displacement."""
    v = command(1)[:6000]
    y = truth().forward(RATE_HZ).process(v)
    return Prepared([History("random", unit * v, um * y, RATE_HZ)], POINTS, OFF)


def test_the_row_is_made_of_the_stages_that_the_field_has() -> None:
    for row, stages in ((LOWEST, LOW), (HIGHEST, HIGH), (STEPS, STEP)):
        assert row.size == len(NAMES)
        assert dict(zip(NAMES, row, strict=True)) | {
            name: getattr(stages, name) for name in STAGES
        } == dict(zip(NAMES, row, strict=True))
    assert (FIRST >= LOWEST).all()
    assert (FIRST <= HIGHEST).all()
    assert FIRST[NAMES.index("output")] > 0.0  # or the flux would make no difference at first


def test_the_flux_rises_over_the_stroke_whatever_its_row() -> None:
    signals = Signals(data())
    for flux_slope, flux_bend in ((2.0, 2.0), (-2.0, -2.0), (0.0, 0.0)):
        x = FIRST.copy()
        x[-3:-1] = flux_slope, flux_bend
        curve = signals.flux(x)
        assert (np.diff(curve.operators) > 0.0).all()
        assert np.ptp(curve.operators) == pytest.approx(np.ptp(curve.displacement_um))


def test_paths_keep_the_turns_and_points_no_further_apart_than_was_asked_for() -> None:
    records = data()
    signals, (run,) = Signals(records), records.runs
    signals.choose(FIRST, 1e-9)
    (path,) = signals.paths(FIRST)
    assert path.field.size == path.displacement_um.size == run.kept.size
    assert 0 <= path.motion.judged < path.field.size
    signals.choose(FIRST, 0.05)
    (coarse,) = signals.paths(FIRST)
    assert coarse.field.size < path.field.size / 2
    between = np.abs(np.diff(path.field)).max()
    assert np.abs(np.diff(coarse.field)).max() <= 0.05 * 2.0 * records.reach + between
    # A turn is where the slopes of the table change from one direction's to the other's.
    assert coarse.field.max() == path.field.max()
    assert coarse.field.min() == path.field.min()
