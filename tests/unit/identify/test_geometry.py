"""Weights of loops against shapes whose peak hysteresis is known."""

import numpy as np
import pytest

from hilctl.base.errors import DataError
from hilctl.identify.data.records import History, SteadyLoop
from hilctl.identify.geometry import hysteresis_weights

TURN = 2.0 * np.pi * np.arange(400) / 400


def ellipse(lag: float, *, frequency_hz: float = 1.0, amplitude: float = 2.0) -> SteadyLoop:
    """Return y = 10 sin(t - lag) over v = amplitude sin t."""
    return SteadyLoop(
        f"{frequency_hz:g} Hz", amplitude * np.sin(TURN), 10.0 * np.sin(TURN - lag), frequency_hz
    )


def test_loops_with_minor_loops_have_a_weight() -> None:
    """All pairs of branches count, so a command of two tones is weighted like any other."""
    command = np.sin(TURN) + 0.5 * np.sin(3.0 * TURN)
    lagging = np.roll(command, 10)
    slow, fast = (
        SteadyLoop("slow", command, lagging, 1.0),
        SteadyLoop("fast", command, command, 2.0),
    )
    np.testing.assert_allclose(hysteresis_weights([slow, fast]), [1.0, 0.0], atol=1e-12)


def test_weights_are_relative_to_the_slowest_and_largest() -> None:
    """Weights are the hysteresis over that of the slowest loop, the largest of several."""
    fast = ellipse(0.6, frequency_hz=100.0)
    small = ellipse(0.5, amplitude=1.0)
    weights = hysteresis_weights([fast, small, ellipse(0.3)])
    expected = np.sin([0.6, 0.5, 0.3]) / np.sin(0.3)
    np.testing.assert_allclose(weights, expected, rtol=4e-3)


def test_weights_need_loops() -> None:
    """A whole history has no peak hysteresis to be weighted by."""
    history = History("decay", np.sin(TURN), np.sin(TURN), 100.0)
    with pytest.raises(DataError, match="whole time history"):
        hysteresis_weights([ellipse(0.3), history])
