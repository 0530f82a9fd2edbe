"""Stages in a row, and the field and displacement that they leave of a record."""

import numpy as np
import pytest

from hilctl.identify.data.records import History
from hilctl.identify.field.preprocess import OFF, Prepared
from hilctl.identify.field.stages import HIGH, LOW, STEP
from hilctl.identify.generalised_duhem.fits import POINTS
from hilctl.identify.generalised_duhem.signals import (
    FIRST,
    FLUX,
    HIGHEST,
    LOWEST,
    NAMES,
    POWERS,
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
    for power in (2.0, -2.0, 0.0):
        x = FIRST.copy()
        x[FLUX] = power
        curve = signals.flux(x)
        assert (np.diff(curve.operators) > 0.0).all()
        assert np.ptp(curve.operators) == pytest.approx(np.ptp(curve.displacement_um))


def test_the_flux_can_be_a_root_of_the_strain_nearly_down_to_where_that_begins() -> None:
    """As in a rod whose strain goes with the square of its magnetisation, of which the flux is."""
    signals = Signals(data())
    place = np.linspace(-1.0, 1.0, 200)
    terms = place[:, None] ** POWERS
    steep = -0.5 * np.log(place + 1.15)
    x = FIRST.copy()
    x[FLUX] = np.linalg.lstsq(np.column_stack((terms, np.ones(200))), steep)[0][:-1]
    curve = signals.flux(x)
    high_um, low_um = curve.displacement_um.max(), curve.displacement_um.min()
    root = np.sqrt(0.15 + 2.0 * (curve.displacement_um - low_um) / (high_um - low_um))
    root = (root - root[0]) / np.ptp(root) * np.ptp(curve.operators)
    off = np.diff(curve.operators - curve.operators[0]) / np.diff(root)
    assert np.abs(off - 1.0).max() < 0.08


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


@pytest.mark.parametrize("stage", range(len(NAMES)))
def test_paths_follow_every_stage_but_the_offset(stage: int) -> None:
    """What was worked out before stands for a row of the same signals, and for no other."""
    kept, fresh = Signals(data()), Signals(data())
    for signals in (kept, fresh):
        signals.choose(FIRST, 0.02)
    (before,) = kept.paths(FIRST)
    x = FIRST.copy()
    x[stage] += STEPS[stage]
    (after,), (expected,) = kept.paths(x), fresh.paths(x)
    np.testing.assert_array_equal(after.field, expected.field)
    np.testing.assert_array_equal(after.displacement_um, expected.displacement_um)
    if NAMES[stage] == "offset":
        assert after is before
    else:
        assert (after.field != before.field).any() or (
            after.displacement_um != before.displacement_um
        ).any()


def test_paths_through_other_points_are_other_paths() -> None:
    signals = Signals(data())
    signals.choose(FIRST, 0.05)
    (coarse,) = signals.paths(FIRST)
    signals.choose(FIRST, 0.01)
    (fine,) = signals.paths(FIRST)
    assert fine.field.size > coarse.field.size
    assert fine.motion.travel.size == fine.field.size
