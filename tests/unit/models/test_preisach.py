"""The Preisach model against a sum of relays."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hilctl.models.preisach import PreisachModel

RATE_HZ = 50_000.0
LOW, HIGH = SPAN = (-7.0, 8.0)
SLOPE = st.floats(0.05, 20.0)
OFFSET = st.floats(-100.0, 100.0)
PLAIN = {"command_span": SPAN}
PREISACH = PreisachModel(
    **PLAIN,
    thresholds=(0.0, 0.7, 1.9),
    lowest=-3.0,
    cell=2.0,
    slopes=((1.0, 2.0, 0.5), (0.0, 1.5, 3.0), (0.7, 0.0, 0.2)),
)


def weights(size):
    """Non-negative weights, many of them 0."""
    value = st.one_of(st.just(0.0), st.floats(0.0, 20.0))
    return st.lists(value, min_size=size, max_size=size).map(tuple)


@st.composite
def preisachs(draw):
    lines, cells = draw(st.integers(1, 6)), draw(st.integers(1, 6))
    steps = draw(st.lists(st.floats(0.01, 3.0), min_size=lines - 1, max_size=lines - 1))
    first = draw(st.lists(SLOPE, min_size=cells, max_size=cells))
    return PreisachModel(
        **PLAIN,
        thresholds=(0.0, *np.cumsum(steps).tolist()),
        lowest=draw(st.floats(-8.0, 2.0)),
        cell=draw(st.floats(0.1, 5.0)),
        slopes=(tuple(first), *(draw(weights(cells)) for _ in range(lines - 1))),
        output_offset_um=draw(OFFSET),
    )


def test_preisach_is_a_sum_of_relays():
    """Thousands of relays (1.1), each switched by itself, give the same displacement."""
    v = np.array([0.0, 2.5, -0.4, 1.3, -2.9, 2.2, -1.0, 0.1, 2.9, -2.9])
    parts = 2_000
    expected = np.zeros(v.size)
    for r, slopes in zip(PREISACH.thresholds, PREISACH.slopes, strict=True):
        width = PREISACH.cell / parts
        centres = PREISACH.lowest + width * (np.arange(3 * parts) + 0.5)
        density = np.repeat(slopes, parts)
        for k in range(v.size):
            if k == 0:
                up = centres < 0.0
                rest = np.sum(density[up])
            up = (up | (v[k] >= centres + r)) & ~(v[k] <= centres - r)
            expected[k] += width * (np.sum(density[up]) - rest)
    np.testing.assert_allclose(PREISACH.forward(RATE_HZ).process(v), expected, atol=0.02)


@given(preisachs())
def test_preisach_rests_at_its_offset(model):
    """At rest the displacement is the offset, whether or not the cells reach there."""
    rest = model.forward(RATE_HZ).process(np.zeros(1)).item()
    assert rest == pytest.approx(model.output_offset_um, abs=1e-9)
