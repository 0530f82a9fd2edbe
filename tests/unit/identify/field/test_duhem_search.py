"""Search of tables of slopes and stages."""

from functools import cache

import numpy as np
import pytest

from hilctl.base.errors import DataError
from hilctl.base.types import F64
from hilctl.identify.data.records import History, SteadyLoop
from hilctl.identify.evaluation import judge
from hilctl.identify.field.duhem_search import DuhemSearch, _bounded_step
from hilctl.identify.field.duhem_tables import FIRST, HIGHEST, LOWEST, NAMES, STEPS, laid_over
from hilctl.identify.fit_api import FitRequest
from hilctl.identify.fit_model import FittedModel, fit_model
from hilctl.identify.settings import FitSettings
from tests.unit.identify.field.test_duhem_tables import RATE_HZ, command, data, truth

SETTINGS = FitSettings(kind="generalised_duhem", cells=10, across=8)


def ready(unit: float = 1.0, um: float = 1.0) -> tuple[DuhemSearch, F64]:
    """Return a search with a table laid, and its first logarithms."""
    job = DuhemSearch(data(unit, um), 8, 6, 0.05 * um / unit)
    job._lay(laid_over(job._chosen(FIRST, 0.03, 500), 8, 6))
    job._first_um = 0.7 * um
    return job, job._layout.first_logs()


def test_slopes_are_those_of_the_errors():
    job, logs = ready()
    errors = job._errors(FIRST, logs)
    slopes = np.empty((errors.size, logs.size))
    job._errors(FIRST, logs, slopes)
    way = np.random.default_rng(1).standard_normal(logs.shape)
    change = (job._errors(FIRST, logs + 1e-5 * way) - errors) / 1e-5
    assert slopes @ way.ravel() == pytest.approx(change, abs=0.02 * np.abs(change).max())


def test_some_steps_lessen_the_error():
    job, logs = ready()
    x, better = job._descend(FIRST, logs, 5, 0.0)
    first, last = (job._errors(*at) for at in ((FIRST, logs), (x, better)))
    assert last @ last < 0.2 * (first @ first)


def test_stages_stay_within_their_bounds_and_the_others_make_up_for_it():
    rng = np.random.default_rng(2)
    size = 5 + len(NAMES)
    root = rng.standard_normal((3 * size, size))
    normal, down = root.T @ root, rng.standard_normal(size)
    wanted = np.zeros(len(NAMES))
    wanted[0] = 10.0 * (LOWEST - FIRST)[0] / STEPS[0]
    down[5] += 1e4 * wanted[0]
    step = _bounded_step(normal, down, 0.0, 5, FIRST)
    at = FIRST + step[5:] * STEPS
    assert at[0] == pytest.approx(LOWEST[0])
    held = np.isclose(at, LOWEST) | np.isclose(at, HIGHEST)
    free = [*range(5), *(5 + np.flatnonzero(~held))]
    assert (normal @ step - down)[free] == pytest.approx(0.0, abs=1e-6)


def test_errors_beyond_what_holds_the_table_ask_for_more_damping():
    """As they do on a rig of two low modes, where no step could be worked out."""
    root = 1e4 * np.random.default_rng(3).standard_normal((2, 5))
    normal, down = root.T @ root, np.ones(5)
    assert _bounded_step(normal - 1e-3 * np.eye(5), down, 1e-9, 5, FIRST) is None
    step = _bounded_step(normal - 1e-3 * np.eye(5), down, 1.0, 5, FIRST)
    assert step is not None
    assert np.isfinite(step).all()


def test_a_descent_goes_on_where_the_first_damping_is_too_little(monkeypatch):
    job, logs = ready()
    dampings: list[float] = []

    def refusing(normal: F64, down: F64, damping: float, table: int, x: F64) -> F64 | None:
        dampings.append(damping)
        return None if len(dampings) == 1 else _bounded_step(normal, down, damping, table, x)

    monkeypatch.setattr("hilctl.identify.field.duhem_search._bounded_step", refusing)
    x, better = job._descend(FIRST, logs, 2, 0.0)
    first, last = (job._errors(*at) for at in ((FIRST, logs), (x, better)))
    assert dampings[1] > dampings[0]
    assert last @ last < first @ first


def test_units_make_no_difference():
    (job, first), (other_job, other_first) = ready(), ready(4.0, 2.0)
    x, logs = job._descend(FIRST, first, 3, 0.0)
    other_x, other_logs = other_job._descend(FIRST, other_first, 3, 0.0)
    assert other_x == pytest.approx(x, abs=1e-4)
    assert other_logs - np.log(0.5) == pytest.approx(logs, abs=1e-2)


def test_progress_rises_below_1():
    seen: list[float] = []
    DuhemSearch(data(), 6, 4, 0.05).find(lambda part, _: seen.append(part))
    assert seen == sorted(set(seen))
    assert 0.0 < seen[0] < seen[-1] < 1.0


def test_a_search_that_goes_on_from_a_rougher_one_ends_no_worse():
    rough = DuhemSearch(data(), 5, 3, 0.05).find(lambda *_: None)
    whole, after = (DuhemSearch(data(), 6, 4, 0.05) for _ in range(2))
    fine, end = whole.find(lambda *_: None), after.go_on(rough)
    spread, other = (
        np.std(job._errors(at.x, at.logs)) for job, at in ((whole, fine), (after, end))
    )
    assert end.logs.shape == fine.logs.shape
    assert other < 1.1 * spread
    assert end.offset_um == pytest.approx(fine.offset_um, abs=0.05)


def history(seed: int, noise_um: float = 0.0, samples: int | None = None) -> History:
    """Return a record of the known model."""
    v = np.ascontiguousarray(command(seed)[:samples])
    noise = noise_um * np.random.default_rng(seed).standard_normal(v.size)
    return History("random", v, truth().forward(RATE_HZ).process(v) + noise, RATE_HZ)


@cache
def found() -> FittedModel:
    """Return what is identified."""
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
