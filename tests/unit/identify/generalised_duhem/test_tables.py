"""Tables of slopes: where their nodes lie, and what holds them smooth."""

import numpy as np
import pytest

from hilctl.base.types import F64
from hilctl.identify.generalised_duhem.signals import Path
from hilctl.identify.generalised_duhem.tables import (
    BENT,
    MARGIN,
    TILTED,
    WIDER,
    Layout,
    laid_over,
    prior,
)

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


def test_nodes_reach_beyond_the_data_by_the_margin() -> None:
    path, here = loops(), layout()
    room = MARGIN * np.ptp(path.displacement_um)
    assert here.nodes_um[0] == pytest.approx(path.displacement_um.min() - room)
    assert here.nodes_um[-1] == pytest.approx(path.displacement_um.max() + room)
    assert here.nodes_um.size == here.centre.size == 13
    assert here.offsets.size == here.across == 7


def test_the_centre_is_the_middle_of_the_loops_and_the_band_holds_all() -> None:
    path, here = loops(), layout()
    inside = (here.nodes_um > -55.0) & (here.nodes_um < 35.0)
    y = here.nodes_um[inside]
    assert here.centre[inside] == pytest.approx(0.1 * y + 2e-4 * y**2, abs=0.06)
    off = path.field - np.interp(path.displacement_um, here.nodes_um, here.centre)
    assert here.half_width == pytest.approx(WIDER * np.abs(off).max())
    assert (np.diff(here.centre) > 0.0).all()


def test_displacements_that_no_path_comes_by_lie_between_those_that_one_does() -> None:
    y = np.concatenate([np.linspace(0.0, 10.0, 400), np.linspace(40.0, 50.0, 400)])
    here = laid_over([Path(0.1 * y, y, 0)], 10, 4)
    assert here.centre == pytest.approx(0.1 * here.nodes_um, abs=0.05)


def test_the_centre_rises_though_loops_are_upright() -> None:
    """Where a displacement is met by one field only, nothing says how steep the middle is."""
    y = np.concatenate([np.linspace(0.0, 40.0, 400), np.linspace(40.0, 0.0, 400)])
    field = np.concatenate([np.linspace(0.0, 4.0, 400), np.full(400, 4.0)])
    here = laid_over([Path(field, y, 0)], 10, 4)
    assert (np.diff(here.centre) > 0.0).all()


def test_a_first_table_brings_loops_towards_the_edges() -> None:
    rising, falling = layout().first_logs()
    assert (np.diff(rising, axis=1) > 0.0).all()
    assert (np.diff(falling, axis=1) < 0.0).all()


def test_a_table_moved_to_other_nodes_is_the_same_function() -> None:
    coarse, fine = layout(12, 6), layout(20, 10)
    moved = fine.moved(logs_of(coarse), coarse)
    expected = logs_of(fine)
    shift = np.interp(fine.nodes_um, coarse.nodes_um, coarse.centre) - fine.centre
    within = np.abs(fine.offsets[None, :] - shift[:, None]) < coarse.half_width
    expected -= np.array([0.3, -0.2])[:, None, None] * shift[:, None]
    assert moved[:, within] == pytest.approx(expected[:, within], abs=1e-9)


def test_the_prior_weighs_bends_more_than_tilts() -> None:
    here = layout()
    rows = prior(here)
    assert rows.shape[1] == 2 * here.centre.size * here.across
    assert rows @ np.full(rows.shape[1], 3.0) == pytest.approx(0.0, abs=1e-12)
    straight, bent = rows @ logs_of(here).ravel(), rows @ logs_of(here, 0.5).ravel()
    tilts = TILTED * np.array([0.01 * here.cell_um, 0.3 * 2 * here.half_width / 6])
    assert np.abs(straight).max() == pytest.approx(max(*tilts, TILTED * 0.02 * here.cell_um))
    apart = 2.0 * here.half_width / 6
    assert np.abs(bent).max() == pytest.approx(BENT * 2.0 * 0.5 * apart**2)
