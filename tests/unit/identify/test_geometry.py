"""SteadyLoop figures against shapes whose figures are known."""

from dataclasses import replace

import numpy as np
import pytest

from hilctl.base.errors import DataError
from hilctl.identify.data.records import History, SteadyLoop
from hilctl.identify.geometry import hysteresis_weights, loop_area, peak_hysteresis_percent

TURN = 2.0 * np.pi * np.arange(400) / 400


def ellipse(lag: float, *, frequency_hz: float = 1.0, amplitude: float = 2.0) -> SteadyLoop:
    """Return y = 10 sin(t - lag) over v = amplitude sin t."""
    return SteadyLoop(
        f"{frequency_hz:g} Hz", amplitude * np.sin(TURN), 10.0 * np.sin(TURN - lag), frequency_hz
    )


@pytest.mark.parametrize("lag", [0.1, 0.5, -0.5])
def test_area_of_an_ellipse(lag: float) -> None:
    """The area is pi times both amplitudes times the sine of the lag, whichever way it turns."""
    loop = ellipse(lag)
    expected = np.pi * 2.0 * 10.0 * abs(np.sin(lag))
    assert loop_area(loop.command, loop.displacement_um) == pytest.approx(expected, rel=1e-3)


@pytest.mark.parametrize("start", [0, 37, 399])
def test_peak_hysteresis_of_an_ellipse(start: int) -> None:
    """The widest place of an ellipse is 2 y sin(lag), wherever the cycle was cut."""
    loop = ellipse(0.3)
    turned = replace(
        loop,
        command=np.roll(loop.command, start),
        displacement_um=np.roll(loop.displacement_um, start),
    )
    assert peak_hysteresis_percent(turned) == pytest.approx(100.0 * np.sin(0.3), rel=2e-3)


def test_peak_hysteresis_needs_two_branches() -> None:
    """A command with minor loops has more than two branches and is refused."""
    loop = SteadyLoop("two tones", np.sin(TURN) + np.sin(3.0 * TURN), np.sin(TURN), 1.0)
    with pytest.raises(DataError, match=r"two tones: .* one maximum and one minimum"):
        peak_hysteresis_percent(loop)


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
