"""Tables of slopes: nodes, prior, and the signals that stages leave of a record."""

import numpy as np
import pytest

from hilctl.base.types import F64
from hilctl.identify.data.records import History
from hilctl.identify.field.duhem_search import POINTS
from hilctl.identify.field.duhem_tables import (
    FIRST,
    FLUX,
    HIGHEST,
    LOWEST,
    MARGIN,
    NAMES,
    POWERS,
    STEPS,
    WIDER,
    Layout,
    Path,
    Signals,
    laid_over,
)
from hilctl.identify.field.preprocess import OFF, Prepared
from hilctl.models.effective_field import FieldLosses
from hilctl.models.linear_stages import FirstMode
from hilctl.models.staged import StagedModel
from tests.unit.models.test_generalised_duhem import duhem_model

RATE_HZ = 20_000.0


def command(seed: int) -> F64:
    """Return a random command from rest, small parts of it after large ones: float64[n]."""
    rng = np.random.default_rng(seed)
    t = np.arange(round(0.9 * RATE_HZ)) / RATE_HZ
    sines = [np.sin(2 * np.pi * f * t + rng.uniform(0, 6)) for f in rng.uniform(4.0, 160.0, 12)]
    wave = np.sum(sines, axis=0)
    return np.ascontiguousarray(5.0 * np.minimum(t / 0.02, 1.0) * wave / np.abs(wave).max())


def truth() -> StagedModel:
    """Return what the data come from."""
    hysteresis = duhem_model(losses=FieldLosses(field_s=1e-4, output_s=5e-6))
    structure = FirstMode(natural_hz=1500.0, damping_ratio=0.2)
    return StagedModel.around(hysteresis, structure=structure, delay_s=5e-5)


def data(unit: float = 1.0, um: float = 1.0) -> Prepared:
    """Return a record in other units of the command and the displacement."""
    v = command(1)[:6000]
    y = truth().forward(RATE_HZ).process(v)
    return Prepared([History("random", unit * v, um * y, RATE_HZ)], POINTS, OFF)


TURNS = np.linspace(0.0, 60.0, 6000)


def loops() -> Path:
    """Return loops that grow to the full range, 0.5 wide either side of a curve."""
    y = 50.0 * np.minimum(TURNS / 30.0, 1.0) * np.sin(TURNS) - 10.0
    field = 0.1 * y + 2e-4 * y**2 + 0.5 * np.cos(TURNS)
    return Path(field, y, 0)


def layout(cells: int = 12, across: int = 6) -> Layout:
    return laid_over([loops()], cells, across)


def logs_of(here: Layout, bend: float = 0.0) -> F64:
    """Return a table that is linear in y and the offset, and bent across."""
    y, off = np.meshgrid(here.nodes_um, here.offsets, indexing="ij")
    return np.stack([0.01 * y + 0.3 * off + bend * off**2, 0.02 * y - 0.2 * off])


def test_nodes_reach_beyond_the_data_by_the_margin():
    path, here = loops(), layout()
    room = MARGIN * np.ptp(path.displacement_um)
    assert here.nodes_um[0] == pytest.approx(path.displacement_um.min() - room)
    assert here.nodes_um[-1] == pytest.approx(path.displacement_um.max() + room)
    assert here.nodes_um.size == here.centre.size == 13
    assert here.offsets.size == here.across == 7


def test_the_centre_is_the_middle_of_the_loops_and_the_band_holds_all():
    path, here = loops(), layout()
    inside = (here.nodes_um > -55.0) & (here.nodes_um < 35.0)
    y = here.nodes_um[inside]
    assert here.centre[inside] == pytest.approx(0.1 * y + 2e-4 * y**2, abs=0.06)
    off = path.field - np.interp(path.displacement_um, here.nodes_um, here.centre)
    assert here.half_width == pytest.approx(WIDER * np.abs(off).max())
    assert (np.diff(here.centre) > 0.0).all()


def test_displacements_that_no_path_comes_by_lie_between_those_that_one_does():
    y = np.concatenate([np.linspace(0.0, 10.0, 400), np.linspace(40.0, 50.0, 400)])
    here = laid_over([Path(0.1 * y, y, 0)], 10, 4)
    assert here.centre == pytest.approx(0.1 * here.nodes_um, abs=0.05)


def test_the_centre_rises_though_loops_are_upright():
    y = np.concatenate([np.linspace(0.0, 40.0, 400), np.linspace(40.0, 0.0, 400)])
    field = np.concatenate([np.linspace(0.0, 4.0, 400), np.full(400, 4.0)])
    here = laid_over([Path(field, y, 0)], 10, 4)
    assert (np.diff(here.centre) > 0.0).all()


def test_a_table_moved_to_other_nodes_is_the_same_function():
    coarse, fine = layout(12, 6), layout(20, 10)
    moved = fine.moved(logs_of(coarse), coarse)
    expected = logs_of(fine)
    shift = np.interp(fine.nodes_um, coarse.nodes_um, coarse.centre) - fine.centre
    within = np.abs(fine.offsets[None, :] - shift[:, None]) < coarse.half_width
    expected -= np.array([0.3, -0.2])[:, None, None] * shift[:, None]
    assert moved[:, within] == pytest.approx(expected[:, within], abs=1e-9)


def test_a_search_begins_within_its_bounds():
    assert FIRST.size == len(NAMES)
    assert (FIRST >= LOWEST).all()
    assert (FIRST <= HIGHEST).all()
    assert FIRST[NAMES.index("output")] > 0.0  # or the flux would make no difference at first


def test_the_flux_rises_over_the_stroke_whatever_its_row():
    signals = Signals(data())
    for power in (2.0, -2.0, 0.0):
        x = FIRST.copy()
        x[FLUX] = power
        curve = signals.flux(x)
        assert (np.diff(curve.operators) > 0.0).all()
        assert np.ptp(curve.operators) == pytest.approx(np.ptp(curve.displacement_um))


def test_the_flux_can_be_a_root_of_the_strain_nearly_down_to_where_that_begins():
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


def test_paths_keep_the_turns_and_points_no_further_apart_than_was_asked_for():
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
def test_paths_follow_every_stage_but_the_offset(stage):
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
