"""Butterfly loops: an even function of plays, inverted on one wing."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from hilctl.base.errors import ModelError
from hilctl.models.butterfly import ButterflyModel
from hilctl.models.deadband import DeadbandFunction
from hilctl.models.model_file import dump_model, parse_model

RATE_HZ = 10_000.0
SHAPE = DeadbandFunction(slope=0.3, up_thresholds=(2.0, 4.0, 9.0), up_weights=(0.7, 1.2, -1.5))


def butterfly(**changes):
    parameters = {
        "direct": 1.0,
        "weights": (0.4, 0.2, 0.1),
        "thresholds": (0.3, 0.6, 1.2),
        "output_range_um": (0.0, 20.0),
        "shape": SHAPE,
    }
    return ButterflyModel(**parameters | changes)


def tone(samples=2000, amplitude=6.0, offset=0.0):
    start = np.minimum(np.arange(samples) / 500.0, 1.0)
    return start * (offset + amplitude * np.sin(2.0 * np.pi * np.arange(samples) / 500.0))


def test_without_bias_displacement_is_even():
    """A command and its opposite give the same displacement, never below the turning point."""
    model = butterfly()
    up = model.forward(RATE_HZ).process(tone())
    down = model.forward(RATE_HZ).process(-tone())
    np.testing.assert_array_equal(up, down)
    assert up.min() >= 0.0
    assert up[500:].max() > 8.0


def test_each_cycle_of_the_command_gives_two_of_displacement():
    """Without bias the displacement repeats twice a cycle; with enough bias, once."""
    two = butterfly().forward(RATE_HZ).process(tone())[-500:]
    one = butterfly(bias=30.0).forward(RATE_HZ).process(tone())[-500:]
    np.testing.assert_allclose(two[:250], two[250:], atol=1e-9)
    assert np.abs(one[:250] - one[250:]).max() > 1.0


@pytest.mark.parametrize(
    ("bias", "input_range", "wing"),
    [(0.0, None, 1.0), (0.0, (-6.0, 0.0), -1.0), (8.0, None, 1.0), (-8.0, (-2.0, 6.0), -1.0)],
)
def test_the_inverse_undoes_the_model_on_its_wing(bias, input_range, wing):
    """Displacements above the turning point come back; the command stays on one wing."""
    rest_um = float(SHAPE(np.array([abs(bias)]))[0])
    model = butterfly(
        bias=bias,
        input_range=input_range,
        output_offset_um=-rest_um,
        output_range_um=(-rest_um, 20.0),
    )
    wanted_um = rest_um * -0.5 + tone(amplitude=0.4 * rest_um + 1.0, offset=0.6 * rest_um + 1.2)
    wanted_um = np.maximum(wanted_um, -rest_um)
    command = model.inverse(RATE_HZ).process(wanted_um)
    got_um = model.forward(RATE_HZ).process(command)
    np.testing.assert_allclose(got_um, wanted_um, atol=1e-9)
    assert model.wing == wing
    if bias == 0.0:
        assert (command[1:] * wing >= 0.0).all()


def test_rest_takes_no_command():
    """Where the offset puts rest at 0 um, the inverse puts out nothing there."""
    rest_um = float(SHAPE(np.array([5.0]))[0])
    model = butterfly(bias=5.0, output_offset_um=-rest_um, output_range_um=(-rest_um, 5.0))
    assert model.inverse(RATE_HZ).process(np.zeros(3)) == pytest.approx(np.zeros(3), abs=1e-12)
    assert model.forward(RATE_HZ).process(np.zeros(3)) == pytest.approx(np.zeros(3), abs=1e-12)


@pytest.mark.parametrize("output_range_um", [None, (-0.1, 20.0)])
def test_both_wings_at_once_are_refused(output_range_um):
    """A range that is not known, or that no command reaches, has no inverse."""
    with pytest.raises(ModelError, match="one of its wings only"):
        butterfly(output_range_um=output_range_um).inverse(RATE_HZ)


def test_what_no_command_reaches_gets_the_turning_point():
    """Below the turning point the inverse stays finite: it holds that point."""
    inverse = butterfly().inverse(RATE_HZ)
    command = inverse.process(np.array([3.0, 1.0, -5.0, -50.0, -5.0, 0.0]))
    assert np.isfinite(command).all()
    assert command[2] == command[3] == command[4] == command[5]


def test_an_odd_shape_is_refused():
    """The side below 0 follows from evenness and can't be given."""
    with pytest.raises(ValidationError, match="even"):
        butterfly(shape=DeadbandFunction(down_thresholds=(-1.0,), down_weights=(0.2,)))


def test_falling_shape_is_refused():
    """A cumulative slope that is not above 0 has no inverse, and is named."""
    with pytest.raises(ValidationError, match="cumulative deadband slope"):
        butterfly(shape={"slope": 1.0, "up_thresholds": (1.0,), "up_weights": (-1.0,)})


def test_file_gives_the_same_model():
    """A model file brings back every parameter, bit for bit."""
    model = butterfly(bias=0.1 + 0.2, gamma_s=1e-4, input_range=(0.0, 6.0))
    assert parse_model("model", dump_model(model)) == model


@given(
    signal=st.lists(st.floats(-1e3, 1e3), min_size=1, max_size=60),
    cut=st.integers(0, 60),
    gamma_s=st.floats(0.0, 1e-3),
    direction=st.sampled_from(["forward", "inverse"]),
)
def test_cuts_make_no_difference_and_nothing_blows_up(signal, cut, gamma_s, direction):
    """Any cut into blocks gives the same bits, finite for anything finite, either way."""
    model = butterfly(gamma_s=gamma_s, bias=-3.0, output_range_um=(0.0, 20.0))
    values = np.array(signal)
    whole = getattr(model, direction)(RATE_HZ).process(values)
    operator = getattr(model, direction)(RATE_HZ)
    parts = [operator.process(values[:cut].copy()), operator.process(values[cut:].copy())]
    np.testing.assert_array_equal(np.concatenate(parts), whole)
    assert np.isfinite(whole).all()
