"""Loops and recordings made from models whose parameters are known."""

from collections.abc import Callable, Sequence

import numpy as np
import pytest

from hilctl.base.segments import Segment
from hilctl.base.types import F64
from hilctl.lab.identify.data.cycles import average_cycle
from hilctl.lab.identify.data.records import SteadyLoop
from hilctl.lab.identify.fit_data import FitData
from hilctl.models.base import HysteresisModel
from hilctl.models.integrated import exponential_integrated
from hilctl.models.plays import PlayModel
from hilctl.recording.recording import Recording

RATE_HZ = 50_000.0
OMEGA = exponential_integrated(
    alpha=0.33, gamma_s=2.5e-4, a_0=3.0, alpha_0=1.4, beta_0=0.23, g_0=1.0, alpha_1=0.08,
    beta_1=0.15, d_p=4.0, alpha_2=0.1, beta_2=0.4, d_n=3.0,
)  # fmt: skip
"""An asymmetric, saturating Omega; g_0 = 1, as identification has it."""


@pytest.fixture
def loops_of() -> Callable[..., list[SteadyLoop]]:
    """Return a function that runs a model on sines and averages the steady cycles."""

    def make(
        model: PlayModel,
        sines: Sequence[tuple[float, float]],
        points: int = 300,
        centre: float = 0.0,
        rate_hz: float = 300 * 250.0,
    ) -> list[SteadyLoop]:
        loops = []
        for amplitude, frequency_hz in sines:
            period = rate_hz / frequency_hz
            time = np.arange(round(4 * period))
            command = centre + amplitude * np.sin(2.0 * np.pi * time / period)
            displacement_um = model.forward(rate_hz).process(command)
            start = round(period)
            values = np.stack([command[start:], displacement_um[start:]])
            phase = np.arange(command.size - start) / period
            label = f"{amplitude:g} at {frequency_hz:g} Hz"
            v, y = average_cycle(label, phase, values, period, points)
            loops.append(SteadyLoop(label, v, y, frequency_hz, rate_hz))
        return loops

    return make


@pytest.fixture
def recording_of(make_recording) -> Callable[..., Recording]:
    """Return a function that wraps command, displacement and segments into a recording."""

    def make(command: F64, displacement_um: F64, segments: Sequence[Segment], **more) -> Recording:
        return make_recording(
            displacement_um, command=command, segments=segments, sample_rate_hz=RATE_HZ, **more
        )

    return make


@pytest.fixture
def loops(loops_of) -> list[SteadyLoop]:
    """Return loops of an Omega of 6 plays and 4 deadbands a side, 150 points each."""
    omega = exponential_integrated(
        alpha=0.9, gamma_s=2e-4, a_0=3.0, alpha_0=1.4, beta_0=0.3, g_0=1.0, alpha_1=0.08,
        beta_1=0.15, d_p=8.0, alpha_2=0.1, beta_2=0.4, d_n=8.0, plays=6, deadbands_a_side=4,
    )  # fmt: skip
    return loops_of(omega, [(a, f) for a in (2.0, 3.0, 6.0) for f in (10.0, 100.0, 250.0)], 150)


def made_loop(
    model: HysteresisModel, amplitude: float, frequency_hz: float = 50.0, points: int = 300
) -> SteadyLoop:
    """Return the third cycle of a model under a sine, each point a sample."""
    command = amplitude * np.sin(2.0 * np.pi * np.arange(points) / points)
    operator = model.forward(points * frequency_hz)
    displacement_um = operator.process(np.tile(command, 4))[-points:]
    label = f"sine {amplitude:g} A {frequency_hz:g} Hz"
    return SteadyLoop(label, command, displacement_um, frequency_hz, RATE_HZ)


@pytest.fixture
def loop_of() -> Callable[..., SteadyLoop]:
    """A maker of one loop, given model, amplitude and frequency."""
    return made_loop


@pytest.fixture
def data_of() -> Callable[[HysteresisModel], FitData]:
    """A maker of loops at 2, 4 and 6 A from a model."""
    return lambda model: FitData([made_loop(model, a) for a in (2.0, 4.0, 6.0)], "A")
