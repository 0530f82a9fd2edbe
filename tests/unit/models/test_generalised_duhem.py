"""The generalised Duhem model: conditions, forward and inverse."""

from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError

from hilctl.models.effective_field import FieldLosses
from hilctl.models.generalised_duhem import GeneralisedDuhemModel
from hilctl.models.linear_stages import FirstMode
from hilctl.models.model_file import dump_model, parse_model
from hilctl.models.staged import StagedModel
from tests.unit.models.test_effective_field import LOSSES, field_model, reference_um

RATE_HZ = 50_000.0
ACROSS = np.linspace(-1.0, 1.0, 5)


def duhem_model(**changes):
    """Return a small model with everything in it."""
    middle = np.array([3.0, 6.0, 7.0, 6.0, 4.0])
    rising = middle[:, None] * np.exp(0.7 * ACROSS)
    given: dict[str, Any] = {
        "lowest_um": -50.0,
        "cell_um": 25.0,
        "centre": (-6.5, -2.4, -0.2, 1.9, 5.4),
        "flux": (-60.0, -27.0, 0.0, 24.0, 45.0),
        "half_width": 1.2,
        "rising": tuple(map(tuple, rising.tolist())),
        "falling": tuple(map(tuple, rising[:, ::-1].tolist())),
        "losses": LOSSES,
        "output_offset_um": 0.7,
    }
    return GeneralisedDuhemModel(**(given | changes))


def test_rest_is_no_command_at_the_offset():
    assert duhem_model().inverse(RATE_HZ).process(np.array([0.7])) == pytest.approx(0.0, abs=1e-12)
    assert duhem_model().forward(RATE_HZ).process(np.zeros(3)) == pytest.approx(0.7, abs=1e-9)


def halved(table):
    """Return a table with a row between every two."""
    return np.insert(table, range(1, len(table)), (table[:-1] + table[1:]) / 2.0, axis=0)


def test_cells_of_several_units_are_the_same_table():
    even, wanted_um = duhem_model(), reference_um(3)
    expected = even.inverse(RATE_HZ).process(wanted_um)
    given = duhem_model(nodes=tuple(range(5))).inverse(RATE_HZ).process(wanted_um)
    assert np.array_equal(given, expected)
    nodes = (0, 1, 2, 3, 4, 6, 8)  # half of the cells are divided
    lines = {
        name: halved(np.array(getattr(even, name)))[list(nodes)]
        for name in ("centre", "flux", "rising", "falling")
    }
    mixed = duhem_model(
        cell_um=12.5,
        nodes=nodes,
        **{name: tuple(lines[name].tolist()) for name in ("centre", "flux")},
        **{name: tuple(map(tuple, lines[name].tolist())) for name in ("rising", "falling")},
    )
    assert mixed.inverse(RATE_HZ).process(wanted_um) == pytest.approx(expected, abs=2e-3)


def test_small_biased_loops_creep_down_from_the_falling_branch():
    loop = [*np.linspace(1.0, 1.2), *np.linspace(1.2, 1.0)]
    turns = np.concatenate([np.linspace(0.0, 4.0), np.linspace(4.0, 1.0), np.tile(loop, 6)])
    out = duhem_model(losses=FieldLosses()).forward(RATE_HZ).process(turns)
    ends = out[99::100]
    assert (np.diff(ends) < 0.0).all()
    assert (np.diff(ends, 2) > 0.0).all()
    assert ends[0] - ends[-1] > 0.5


def test_a_loop_is_the_wider_the_faster_it_is():
    def area(frequency_hz):
        t = np.arange(round(2 * RATE_HZ / frequency_hz)) / RATE_HZ
        v = 4.0 * np.sin(2 * np.pi * frequency_hz * t)
        half = v.size // 2
        y = duhem_model().forward(RATE_HZ).process(v)
        return abs(float(np.trapezoid(y[half:], v[half:])))

    assert area(200.0) > 1.1 * area(5.0)


RODS = {"field": field_model(), "duhem": duhem_model()}
of_rods = pytest.mark.parametrize("model", RODS.values(), ids=RODS)


@of_rods
@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_what_is_no_number_leaves_no_trace_and_a_state_goes_on(model, bad):
    wanted_um = reference_um(3)
    inverse, other = model.inverse(RATE_HZ), model.inverse(RATE_HZ)
    first = inverse.process(wanted_um[:100].copy())
    other.restore(inverse.state())
    assert np.isnan(inverse.process(np.array([bad])))
    after = inverse.process(wanted_um[100:].copy())
    whole = model.inverse(RATE_HZ).process(wanted_um)
    assert np.array_equal(np.concatenate([first, after]), whole)
    assert np.array_equal(other.process(wanted_um[100:].copy()), after)


@of_rods
def test_every_finite_reference_gives_a_finite_command(model):
    wild_um = np.array([0.0, 1e3, -1e3, 1e9, -1e9, 0.0, 1e-9])
    inverse = model.inverse(RATE_HZ)
    assert np.isfinite(inverse.process(wild_um)).all()
    again = inverse.process(np.concatenate([[0.0], reference_um(5)]))
    assert np.abs(again[200:]).max() < 20.0  # it has come back


@of_rods
def test_between_stages_and_through_a_file(model):
    structure = FirstMode(natural_hz=2300.0, damping_ratio=0.12)
    staged = StagedModel.around(model, structure=structure, delay_s=3e-5)
    back = parse_model("model", dump_model(staged))
    assert back == staged
    inverse, wanted_um = back.inverse(RATE_HZ), model.output_offset_um + reference_um(4)
    ahead = np.append(wanted_um[inverse.preview :], np.full(inverse.preview, wanted_um[-1]))
    got_um = back.forward(RATE_HZ).process(inverse.process(ahead))
    assert np.max(np.abs(got_um - wanted_um)[500:-500]) < 0.005 * np.ptp(wanted_um)


ROWS = ((1.0, 2.0),) * 5


@pytest.mark.parametrize(("changes", "words"), [
    ({"cell_um": 0.0}, "cell_um must be > 0"),
    ({"nodes": (0, 1, 2, 3)}, "nodes must rise from 0"),
    ({"nodes": (1, 2, 3, 4, 5)}, "nodes must rise from 0"),
    ({"nodes": (0, 1, 2, 2, 3)}, "nodes must rise from 0"),
    ({"nodes": (0, 1, 2, 3, 10**9)}, "nodes must be at most"),
    ({"centre": (-6.5, -2.4, -2.4, 1.9, 5.4)}, "centre must rise"),
    ({"flux": (-6.5, -2.4, -2.4, 1.9, 5.4)}, "flux must rise"),
    ({"flux": (-6.5, 5.4)}, "flux must have"),
    ({"rising": ROWS[:4], "falling": ROWS}, "rising must have"),
    ({"rising": ROWS, "falling": ((1.0, 2.0, 3.0),) * 5}, "all of one length"),
    ({"rising": ((1.0, 0.0),) * 5, "falling": ROWS}, "rising must be > 0"),
    ({"rising": ROWS, "falling": ((1.0, -1.0),) * 5}, "falling must be > 0"),
    ({"half_width": 0.1}, "half_width must be at least"),
])  # fmt: skip
def test_conditions(changes, words):
    with pytest.raises(ValidationError, match=words):
        duhem_model(**changes)
