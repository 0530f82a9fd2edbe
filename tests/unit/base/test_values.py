"""Values that are worked out part by part: the same bits as all of them at once."""

import numpy as np
import pytest

from hilctl.base import values as module
from hilctl.base.values import Added, Ahead, chunks, fit, held, in_memory

PLAIN = np.random.default_rng(5).normal(size=1000)


def squares(start, stop):
    return np.arange(start, stop, dtype=np.float64) ** 2


@pytest.mark.parametrize("size", [1, 7, 499, 500, 501, 1000])
@pytest.mark.parametrize(
    "made",
    [
        Added(PLAIN, squares, 500),
        Added(PLAIN, squares, 0),
        Ahead(PLAIN, 3),
        Ahead(PLAIN, 999),
        Ahead(PLAIN, 5000),
        Ahead(Added(PLAIN, squares, 10), 7),
    ],
)
def test_however_divided(made, size):
    whole = made[:]
    parts = [made[start : start + size] for start in range(0, 1000, size)]
    assert np.concatenate(parts).tobytes() == whole.tobytes()
    assert made.size == whole.size == 1000


def test_something_is_added_to_the_first_of_them():
    added = Added(PLAIN, squares, 10)[:]
    assert (added[:10] - PLAIN[:10]).tolist() == pytest.approx([k**2 for k in range(10)])
    assert added[10:].tolist() == PLAIN[10:].tolist()


def test_ahead_the_last_one_stands_for_those_after_it():
    assert Ahead(PLAIN, 3)[:].tolist() == [*PLAIN[3:], *[PLAIN[-1]] * 3]
    assert Ahead(PLAIN, 1001)[:].tolist() == [PLAIN[-1]] * 1000


def test_what_fits_is_held_as_an_array(monkeypatch):
    made = Ahead(PLAIN, 3)
    assert in_memory(held(made))
    monkeypatch.setattr(module, "IN_MEMORY", 999)
    assert held(made) is made
    assert not in_memory(made)
    assert fit(999)
    assert not fit(1000)


def test_chunks_are_of_all_or_of_some_parts(monkeypatch):
    monkeypatch.setattr(module, "CHUNK", 300)
    assert [each.size for each in chunks(PLAIN)] == [300, 300, 300, 100]
    told = [each.tolist() for each in chunks(PLAIN, (slice(0, 301), slice(990, 1000)))]
    assert [len(each) for each in told] == [300, 1, 10]
    assert told[1] == [PLAIN[300]]
    assert told[2] == PLAIN[990:].tolist()
