"""Loops that a known model made."""

from collections.abc import Callable

import numpy as np
import pytest

from hilctl.comparison.data import Frame
from hilctl.identify.data import Loop
from hilctl.models.base import HysteresisModel

RATE_HZ = 50_000.0
POINTS = 300


def made_loop(model: HysteresisModel, amplitude: float, frequency_hz: float = 50.0) -> Loop:
    angle = 2.0 * np.pi * np.arange(POINTS) / POINTS
    command = amplitude * np.sin(angle)
    operator = model.forward(POINTS * frequency_hz)
    displacement_um = operator.process(np.tile(command, 4))[-POINTS:]
    label = f"sine {amplitude:g} A {frequency_hz:g} Hz"
    return Loop(label, command, displacement_um, frequency_hz, RATE_HZ)


@pytest.fixture
def loop_of() -> Callable[..., Loop]:
    """A maker of one loop, given model, amplitude and frequency."""
    return made_loop


@pytest.fixture
def frame_of() -> Callable[[HysteresisModel], Frame]:
    """A maker of loops at 2, 4 and 6 A from a model."""
    return lambda model: Frame([made_loop(model, a) for a in (2.0, 4.0, 6.0)], "A")
