"""The streaming operator: memory, restart, offsets."""

import numpy as np
import pytest
from pydantic import ValidationError

from hilctl.base.errors import ModelError
from hilctl.models.plays import PpiModel
from tests.unit.models.test_plays import MODELS

SAMPLE_RATE_HZ = 10_000.0
SIGNAL = 3.0 * np.sin(np.arange(500) / 30.0) + 0.4 * np.sin(np.arange(500) / 3.0)


@pytest.fixture(params=MODELS)
def model(request):
    return MODELS[request.param]


@pytest.fixture(params=["forward", "inverse"])
def make(request, model):
    """A maker of that model's operator, forward or inverse."""
    return lambda: getattr(model, request.param)(SAMPLE_RATE_HZ)


def test_reset_at_a_first_input_continues_from_there(make):
    """reset(v0) leaves the operator as a first sample of v0 does."""
    begun, reset = make(), make()
    begun.process(np.array([1.7]))
    reset.process(SIGNAL)
    reset.reset(1.7)
    np.testing.assert_array_equal(reset.state(), begun.state())


def test_operators_of_one_model_are_independent(model):
    first, second = model.forward(SAMPLE_RATE_HZ), model.forward(SAMPLE_RATE_HZ)
    first.process(SIGNAL)
    np.testing.assert_array_equal(second.state()[:3], np.zeros(3))


def test_a_state_of_another_model_is_refused(make):
    with pytest.raises(ModelError, match=r"4 values.*got 7"):
        make().restore(np.zeros(7))


def test_out_is_filled_and_returned(make):
    out, block = np.empty_like(SIGNAL), SIGNAL.copy()
    assert make().process(block, out) is out
    np.testing.assert_array_equal(out, make().process(SIGNAL))
    np.testing.assert_array_equal(block, SIGNAL)


def test_out_may_be_the_block_itself(make):
    block = SIGNAL.copy()
    make().process(block, block)
    np.testing.assert_array_equal(block, make().process(SIGNAL))


def test_offset_moves_the_output_and_comes_off_first(model):
    moved = model.model_copy(update={"output_offset_um": 7.0})
    plain = model.forward(SAMPLE_RATE_HZ).process(SIGNAL)
    np.testing.assert_array_equal(moved.forward(SAMPLE_RATE_HZ).process(SIGNAL), plain + 7.0)
    block = SIGNAL + 7.0
    shifted = moved.inverse(SAMPLE_RATE_HZ).process(block)
    np.testing.assert_array_equal(block, SIGNAL + 7.0)
    expected = model.inverse(SAMPLE_RATE_HZ).process(block - 7.0)
    np.testing.assert_array_equal(shifted, expected)


def test_infinite_states_and_models_without_end_are_refused():
    operator = PpiModel(direct=1.0, weights=(1.0,), thresholds=(1.0,)).forward(1.0)
    operator.restore(np.array([1.0, np.nan]))
    with pytest.raises(ModelError, match="no infinite value"):
        operator.restore(np.array([np.inf, 0.0]))
    many = tuple(float(i) for i in range(1, 10_002))
    with pytest.raises(ValidationError, match="at most 10000 operators: 10001"):
        PpiModel(direct=1.0, weights=many, thresholds=many)
