"""Tables of slopes and stages: layout, prior, signals and search."""

from functools import cache
from typing import Any

import numpy as np
import pytest

from hilctl.base.errors import DataError
from hilctl.base.types import F64
from hilctl.lab.identify.data.records import History, SteadyLoop
from hilctl.lab.identify.evaluation import judge
from hilctl.lab.identify.field.duhem_search import (
    FINE,
    FIRST,
    FLUX,
    HIGHEST,
    LOWEST,
    NAMES,
    POINTS,
    POWERS,
    STEPS,
    Bounds,
    DuhemEnd,
    DuhemProblem,
    DuhemSearch,
    Points,
    SearchPhase,
    Signals,
    _bounded_step,
)
from hilctl.lab.identify.field.duhem_table import WIDER, Layout, Path, laid_over
from hilctl.lab.identify.field.preprocess import OFF, Prepared
from hilctl.lab.identify.fit_api import FitRequest
from hilctl.lab.identify.fit_model import FittedModel, fit_model
from hilctl.lab.identify.settings import FitSettings
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
    return Path(field, y)


def layout(cells: int = 12, across: int = 6) -> Layout:
    return laid_over([loops()], cells, across)


def logs_of(here: Layout, bend: float = 0.0) -> F64:
    """Return a table that is linear in y and the offset, and bent across."""
    y, off = np.meshgrid(here.nodes_um, here.offsets, indexing="ij")
    return np.stack([0.01 * y + 0.3 * off + bend * off**2, 0.02 * y - 0.2 * off])


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
    here = laid_over([Path(0.1 * y, y)], 10, 4)
    assert here.centre == pytest.approx(0.1 * here.nodes_um, abs=0.05)


def test_the_centre_rises_though_loops_are_upright():
    y = np.concatenate([np.linspace(0.0, 40.0, 400), np.linspace(40.0, 0.0, 400)])
    field = np.concatenate([np.linspace(0.0, 4.0, 400), np.full(400, 4.0)])
    here = laid_over([Path(field, y)], 10, 4)
    assert (np.diff(here.centre) > 0.0).all()


def test_a_few_wide_loops_do_not_bend_the_centre():
    """As the loops of the fastest sines, whose losses are not known yet."""
    narrow, turns = loops(), np.linspace(0.0, 2.0 * np.pi, 400)
    y = -10.0 + 25.0 * np.sin(turns)
    wide = Path(0.1 * y + 2e-4 * y**2 + 4.0 * np.cos(turns) * (np.cos(turns) > 0.0), y)
    here = laid_over([narrow, wide], 12, 6)
    assert here.slopes.max() < 2.0 * here.slopes.min()


def test_the_centre_follows_the_line_of_equal_slopes():
    here = layout()
    equal = here.anhysteretic(logs_of(here))
    most = here.offsets[-2]
    assert equal - here.centre == pytest.approx(np.clip(0.02 * here.nodes_um, -most, most))
    following = laid_over([loops()], 12, 6, (here.nodes_um, equal))
    expected = np.interp(following.nodes_um, here.nodes_um, equal)
    assert following.centre == pytest.approx(expected, abs=0.02)


def test_cells_are_narrow_where_a_rod_saturates():
    """In the upper tenth of the stroke, which takes half of the command."""
    here = laid_over([loops()], 20, 6, (np.array([-60.0, 30.0, 40.0]), np.array([-5.0, 0.0, 5.0])))
    widths, parts = np.diff(here.nodes_um), np.diff(here.centre) / np.ptp(here.centre)
    steep = here.nodes_um[1:] > 30.0
    assert steep.sum() >= 6
    assert np.ptp(widths[:10]) <= 1.01 * here.unit_um
    assert parts[steep].max() < 0.5 * 0.25  # of the command: even cells would have a quarter each


def test_cells_are_equal_without_saturation():
    here = laid_over([loops()], 20, 6, (np.array([-60.0, 40.0]), np.array([-5.0, 5.0])))
    assert (np.diff(here.nodes) == np.diff(here.nodes)[0]).all()


def test_no_cell_is_narrower_than_a_unit():
    line = np.array([-60.0, 29.0, 29.1, 40.0]), np.array([-5.0, -4.9, 4.9, 5.0])
    here = laid_over([loops()], 20, 6, line)
    assert here.nodes.size == 21
    assert np.diff(here.nodes).min() >= 1


def test_a_table_moved_to_other_nodes_is_the_same_function():
    coarse, fine = layout(12, 6), layout(20, 10)
    moved = fine.moved(logs_of(coarse), coarse)
    expected = logs_of(fine)
    shift = np.interp(fine.nodes_um, coarse.nodes_um, coarse.centre) - fine.centre
    within = np.abs(fine.offsets[None, :] - shift[:, None]) < coarse.half_width
    expected -= np.array([0.3, -0.2])[:, None, None] * shift[:, None]
    assert moved[:, within] == pytest.approx(expected[:, within], abs=1e-9)


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
    points = Points(signals, FIRST, 0.0, 1e-9)
    (path,), (motion,) = points.paths(FIRST), points.motions
    assert path.field.size == path.displacement_um.size == run.kept.size
    assert motion.judged.size == path.field.size
    (coarse,) = Points(signals, FIRST, 1e-3, 0.05).paths(FIRST)
    assert coarse.field.size < path.field.size / 2
    between = np.abs(np.diff(path.field)).max()
    assert np.abs(np.diff(coarse.field)).max() <= 0.05 * 2.0 * records.reach + between
    # A turn is where the slopes of the table change from one direction's to the other's.
    assert coarse.field.max() == path.field.max()
    assert coarse.field.min() == path.field.min()


OF_PLAYS = {"activation", "accommodation"}


@pytest.mark.parametrize("stage", [k for k, name in enumerate(NAMES) if name not in OF_PLAYS])
def test_paths_follow_every_stage_but_the_offset(stage):
    kept, fresh = (Points(Signals(data()), FIRST, 1e-3) for _ in range(2))
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


SETTINGS = FitSettings(kind="generalised_duhem", cells=10, across=8)


def ready(unit: float = 1.0, um: float = 1.0, steps: int = 3) -> tuple[DuhemProblem, F64]:
    """Return a problem, and its first logarithms."""
    signals = Signals(data(unit, um))
    points = Points(signals, FIRST, 1e-3)
    here = laid_over(points.paths(FIRST), 8, 6)
    bounds = Bounds(LOWEST, HIGHEST, FIRST, (float(np.log(0.05 * um / unit)), 10.0))
    phase = SearchPhase(rows=500, steps=steps, gain=0.0, held=1e-2)
    return DuhemProblem(signals, points, here, 0.7 * um, bounds, phase), here.first_logs()


def test_slopes_are_those_of_the_errors():
    job, logs = ready()
    errors = job.errors(FIRST, logs)
    slopes = job.by_table(FIRST, logs)
    way = np.random.default_rng(1).standard_normal(logs.shape)
    change = (job.errors(FIRST, logs + 1e-5 * way) - errors) / 1e-5
    assert slopes @ way.ravel() == pytest.approx(change, abs=0.02 * np.abs(change).max())


def test_some_steps_lessen_the_error():
    job, logs = ready(steps=5)
    x, better = job.descend(FIRST, logs)
    first, last = (job.errors(*at) for at in ((FIRST, logs), (x, better)))
    assert last @ last < 0.2 * (first @ first)


def test_stages_stay_within_their_bounds_and_the_others_make_up_for_it():
    rng = np.random.default_rng(2)
    size = 5 + len(NAMES)
    root = rng.standard_normal((3 * size, size))
    normal, down = root.T @ root, rng.standard_normal(size)
    wanted = np.zeros(len(NAMES))
    wanted[0] = 10.0 * (LOWEST - FIRST)[0] / STEPS[0]
    down[5] += 1e4 * wanted[0]
    step = _bounded_step(normal, down, 0.0, 5, FIRST, (LOWEST, HIGHEST))
    at = FIRST + step[5:] * STEPS
    assert at[0] == pytest.approx(LOWEST[0])
    held = np.isclose(at, LOWEST) | np.isclose(at, HIGHEST)
    free = [*range(5), *(5 + np.flatnonzero(~held))]
    assert (normal @ step - down)[free] == pytest.approx(0.0, abs=1e-6)


def test_errors_beyond_what_holds_the_table_ask_for_more_damping():
    """As they do on a rig of two low modes, where no step could be worked out."""
    root = 1e4 * np.random.default_rng(3).standard_normal((2, 5))
    normal, down = root.T @ root, np.ones(5)
    assert _bounded_step(normal - 1e-3 * np.eye(5), down, 1e-9, 5, FIRST, (LOWEST, HIGHEST)) is None
    step = _bounded_step(normal - 1e-3 * np.eye(5), down, 1.0, 5, FIRST, (LOWEST, HIGHEST))
    assert step is not None
    assert np.isfinite(step).all()


def test_a_descent_goes_on_where_the_first_damping_is_too_little(monkeypatch):
    job, logs = ready()
    dampings: list[float] = []

    def refusing(normal: F64, down: F64, damping: float, *others: Any) -> F64 | None:
        dampings.append(damping)
        return None if len(dampings) == 1 else _bounded_step(normal, down, damping, *others)

    monkeypatch.setattr("hilctl.lab.identify.field.duhem_search._bounded_step", refusing)
    x, better = job.descend(FIRST, logs)
    first, last = (job.errors(*at) for at in ((FIRST, logs), (x, better)))
    assert dampings[1] > dampings[0]
    assert last @ last < first @ first


def test_a_step_that_gains_too_little_of_its_prediction_is_rejected(monkeypatch):
    job, logs = ready()
    monkeypatch.setattr("hilctl.lab.identify.field.duhem_search.TRUSTED", 10.0)
    x, same = job.descend(FIRST, logs)
    assert (x == FIRST).all()
    assert (same == logs).all()


def test_units_make_no_difference():
    (job, first), (other_job, other_first) = ready(), ready(4.0, 2.0)
    x, logs = job.descend(FIRST, first)
    other_x, other_logs = other_job.descend(FIRST, other_first)
    assert other_x == pytest.approx(x, abs=1e-4)
    assert other_logs - np.log(0.5) == pytest.approx(logs, abs=1e-2)


def spread(end: DuhemEnd) -> float:
    """Return the rms error of the field at the end of a search of the record."""
    (run,) = data().runs
    signals = Signals(data())
    points = Points(signals, end.x, 1e-3)
    bounds = Bounds(LOWEST, HIGHEST, FIRST, (-10.0, 10.0))
    first_um = end.offset_um - float(end.x[-1]) * 0.5 * float(np.ptp(run.derivatives[0]))
    job = DuhemProblem(signals, points, end.layout, first_um, bounds, FINE)
    (path,), (rows,) = points.paths(end.x), job.rows.samples
    # Errors of a problem are scaled by its own centre line.
    slopes = end.layout.slopes_at(path.displacement_um[rows])
    return float(np.std(job.errors(end.x, end.logs) / slopes))


def test_a_search_that_goes_on_from_a_rougher_one_ends_no_worse():
    rough = DuhemSearch(data(), 5, 3, 0.05).find(lambda *_: None)
    fine = DuhemSearch(data(), 10, 8, 0.05).find(lambda *_: None)
    end = DuhemSearch(data(), 10, 8, 0.05).go_on(rough)
    assert end.logs.shape == fine.logs.shape
    assert spread(end) < 1.1 * spread(fine)
    assert end.offset_um == pytest.approx(fine.offset_um, abs=0.05)


def history(seed: int, noise_um: float = 0.0, samples: int | None = None) -> History:
    """Return a record of the known model."""
    v = np.ascontiguousarray(command(seed)[:samples])
    noise = noise_um * np.random.default_rng(seed).standard_normal(v.size)
    return History("random", v, truth().forward(RATE_HZ).process(v) + noise, RATE_HZ)


@cache
def found() -> FittedModel:
    return fit_model(FitRequest([history(1, 0.01)], SETTINGS))


@pytest.mark.slow
def test_a_history_that_was_not_fitted_is_met():
    judged = judge(found().model, [history(2)])
    assert judged.rms_percent < 0.1
    assert judged.peak_percent < 1.5


def test_the_stages_are_found():
    parameters = found().parameters
    assert parameters["field_s"] == pytest.approx(1e-4, rel=0.3)
    assert parameters["output_s"] == pytest.approx(5e-6, rel=0.3)
    assert parameters["natural_hz"] == pytest.approx(1500.0, rel=0.2)
    assert parameters["output_offset_um"] == pytest.approx(0.7, abs=0.1)


def test_the_table_is_of_the_size_that_was_asked_for():
    hysteresis = found().model.hysteresis
    assert len(hysteresis.rising) == len(hysteresis.falling) == SETTINGS.cells + 1
    assert {len(row) for row in hysteresis.rising} == {SETTINGS.across + 1}
    assert found().numbers == 2 * (SETTINGS.cells + 1) * (SETTINGS.across + 1) + 14


@pytest.mark.slow
def test_records_begin_at_rest_each():
    both = fit_model(FitRequest([history(1, 0.01, 9000), history(3, 0.01, 9000)], SETTINGS))
    assert judge(both.model, [history(2)]).rms_percent < 0.2


@pytest.mark.parametrize("kind", ["field", "generalised_duhem"])
def test_steady_loops_are_refused(kind):
    """They leave so much open that what is found would differ from processor to processor."""
    wave = np.sin(2.0 * np.pi * np.arange(64) / 64)
    loop = SteadyLoop("3 A 10 Hz", 3.0 * wave, 20.0 * wave, 10.0, RATE_HZ)
    with pytest.raises(DataError, match="3 A 10 Hz"):
        fit_model(FitRequest([loop], FitSettings(kind=kind)))
