"""The compensator: its input, memory and refusals."""

from dataclasses import replace

import numpy as np
import pytest

from hilctl.base.errors import ModelError
from hilctl.base.segments import Segment
from hilctl.loop.compensator import Compensator
from hilctl.models.staged import FieldLag, StagedModel
from tests.published import terfenol_rdpi

RATE_HZ = 10_000.0
STAGED = StagedModel.around(terfenol_rdpi(), lag=FieldLag(tau_s=2e-4), delay_s=3e-4)


@pytest.mark.parametrize("model", [None, terfenol_rdpi()])
def test_without_preview_the_reference_itself_is_fed(model):
    reference = np.arange(5.0)
    compensator = Compensator(model, RATE_HZ)
    assert compensator.preview == 0
    assert compensator.ahead(reference) is reference


@pytest.mark.parametrize(("size", "fed"), [
    (6, [4.0, 5.0, 5.0, 5.0, 5.0, 5.0]),
    (4, [3.0, 3.0, 3.0, 3.0]),
    (1, [0.0]),
])  # fmt: skip
def test_reference_is_fed_ahead_of_its_time_and_held_at_its_end(size, fed):
    compensator = Compensator(STAGED, RATE_HZ)
    assert compensator.preview == 4
    assert compensator.ahead(np.arange(float(size))).tolist() == fed


SINE = Segment("sine", 0, 100, 20, 100, 25.4)


@pytest.mark.parametrize(("last", "continues"), [
    (SINE, True),
    (replace(SINE, period=3.0), True),
    (replace(SINE, steady_stop=90), False),
    (replace(SINE, steady_start=80), False),
    (replace(SINE, period=0.0), False),
    (replace(SINE, label="file"), False),
])  # fmt: skip
def test_a_periodic_reference_continues_beyond_its_end(last, continues):
    wave = np.sin(2.0 * np.pi * np.arange(104) / (last.period or SINE.period))
    fed = Compensator(STAGED, RATE_HZ).ahead(wave[:100], last)
    assert (np.abs(fed - wave[4:]).max() < 0.01) == continues


def test_first_command_belongs_to_the_initial_output():
    step = np.where(np.arange(60) < 1, 0.0, 3.0)
    later = np.concatenate((np.zeros(30), step))
    begun, whole = np.empty(60), np.empty(90)
    compensator = Compensator(STAGED, RATE_HZ)
    compensator.begin(step)
    compensator.process(compensator.ahead(step), begun)
    before = Compensator(STAGED, RATE_HZ)
    before.process(before.ahead(later), whole)
    np.testing.assert_allclose(begun, whole[30:], atol=1e-12)


def test_warm_up_leaves_no_trace():
    signal = np.sin(np.arange(50) / 5.0)
    wanted, cold = np.empty(50), np.empty(50)
    Compensator(STAGED, RATE_HZ).process(signal, cold)
    warm = Compensator(STAGED, RATE_HZ)
    state = warm.state()
    warm.warm_up()
    np.testing.assert_array_equal(warm.state(), state)
    warm.process(signal, wanted)
    np.testing.assert_array_equal(wanted, cold)
    assert warm.state_size == state.size


def test_without_a_model_there_is_no_memory():
    compensator, wanted = Compensator(None, RATE_HZ), np.empty(3)
    compensator.process(np.arange(3.0), wanted)
    assert wanted.tolist() == [0.0, 1.0, 2.0]
    assert compensator.state_size == 0
    with pytest.raises(ModelError, match="2 values"):
        compensator.restore(np.zeros(2))
