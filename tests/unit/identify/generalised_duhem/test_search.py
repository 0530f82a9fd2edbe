"""Steps of the search: their slopes, their bounds, and what makes no difference."""

import numpy as np
import pytest

from hilctl.base.types import F64
from hilctl.identify.generalised_duhem.search import FIRM, FIRMER, DuhemSearch, _bounded_step
from hilctl.identify.generalised_duhem.signals import FIRST, HIGHEST, LOWEST, NAMES, STEPS
from hilctl.identify.generalised_duhem.tables import laid_over
from tests.unit.identify.generalised_duhem.test_signals import data


def ready() -> tuple[DuhemSearch, F64]:
    """Return a search with a table laid, and its first logarithms."""
    job = DuhemSearch(data(), 8, 6, 0.05)
    job._lay(laid_over(job._chosen(FIRST, 0.03, 500), 8, 6))
    job._first_um = 0.7
    return job, job._layout.first_logs()


def test_slopes_are_those_of_the_errors() -> None:
    job, logs = ready()
    errors = job._errors(FIRST, logs)
    slopes = np.empty((errors.size, logs.size))
    job._errors(FIRST, logs, slopes)
    way = np.random.default_rng(1).standard_normal(logs.shape)
    change = (job._errors(FIRST, logs + 1e-5 * way) - errors) / 1e-5
    assert slopes @ way.ravel() == pytest.approx(change, abs=0.02 * np.abs(change).max())


def test_some_steps_lessen_the_error() -> None:
    job, logs = ready()
    x, better = job._descend(FIRST, logs, 5, 0.0)
    first, last = (job._errors(*at) for at in ((FIRST, logs), (x, better)))
    assert last @ last < 0.2 * (first @ first)


def test_stages_stay_within_their_bounds_and_the_others_make_up_for_it() -> None:
    """As the least of the quadratic on that bound has it."""
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


def test_errors_beyond_what_holds_the_table_ask_for_more_damping() -> None:
    """As they do on a rig of two low modes, where no step could be worked out."""
    root = 1e4 * np.random.default_rng(3).standard_normal((2, 5))
    normal, down = root.T @ root, np.ones(5)
    assert _bounded_step(normal - 1e-3 * np.eye(5), down, 1e-9, 5, FIRST) is None
    step = _bounded_step(normal - 1e-3 * np.eye(5), down, 1.0, 5, FIRST)
    assert step is not None
    assert np.isfinite(step).all()


def test_a_descent_goes_on_where_the_first_damping_is_too_little(monkeypatch) -> None:
    job, logs = ready()
    dampings: list[float] = []

    def refusing(normal: F64, down: F64, damping: float, table: int, x: F64) -> F64 | None:
        dampings.append(damping)
        return None if len(dampings) == 1 else _bounded_step(normal, down, damping, table, x)

    monkeypatch.setattr("hilctl.identify.generalised_duhem.search._bounded_step", refusing)
    x, better = job._descend(FIRST, logs, 2, 0.0)
    first, last = (job._errors(*at) for at in ((FIRST, logs), (x, better)))
    assert dampings[1] > dampings[0]
    assert last @ last < first @ first


def test_units_make_no_difference() -> None:
    def ends(unit: float, um: float) -> tuple[F64, F64]:
        job = DuhemSearch(data(unit, um), 8, 6, 0.05 * um / unit)
        job._lay(laid_over(job._chosen(FIRST, 0.03, 500), 8, 6))
        job._first_um = 0.7 * um
        x, logs = job._descend(FIRST, job._layout.first_logs(), 3, 0.0)
        return x, logs - np.log(um / unit)

    one, other = ends(1.0, 1.0), ends(4.0, 2.0)
    assert other[0] == pytest.approx(one[0], abs=1e-4)
    assert other[1] == pytest.approx(one[1], abs=1e-2)


def test_progress_rises_below_1() -> None:
    seen: list[float] = []
    DuhemSearch(data(), 6, 4, 0.05).find(lambda part, _: seen.append(part))
    assert seen == sorted(set(seen))
    assert 0.0 < seen[0] < seen[-1] < 1.0


def test_slopes_are_held_alike_the_more_the_rougher_the_table(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """What is held too little in the first long steps comes to lie where nothing moves it."""
    held = []

    def descend(job: DuhemSearch, x: F64, logs: F64, *_: object, **__: object) -> tuple[F64, F64]:
        rough = np.random.default_rng(4).standard_normal(logs.shape)
        held.append(
            job._cost(FIRST, rough, np.zeros(1))
            / float(rough.ravel() @ job._smooth @ rough.ravel())
        )
        return x, logs

    monkeypatch.setattr(DuhemSearch, "_descend", descend)
    DuhemSearch(data(), 6, 4, 0.05).find(lambda *_: None)
    assert held == pytest.approx([FIRMER, FIRM, 1.0])
    assert FIRMER > FIRM > 1.0


def test_a_search_that_goes_on_from_a_rougher_one_ends_no_worse() -> None:
    rough = DuhemSearch(data(), 5, 3, 0.05).find(lambda *_: None)
    whole, after = (DuhemSearch(data(), 6, 4, 0.05) for _ in range(2))
    fine, end = whole.find(lambda *_: None), after.go_on(rough)
    spread, other = (
        np.std(job._errors(at.x, at.logs)) for job, at in ((whole, fine), (after, end))
    )
    assert end.logs.shape == fine.logs.shape
    assert other < 1.1 * spread
    assert end.offset_um == pytest.approx(fine.offset_um, abs=0.05)
