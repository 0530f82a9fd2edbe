"""Loops and recordings made from models whose parameters are known."""

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pytest

from hilctl.base.samples import Samples
from hilctl.base.segments import Segment
from hilctl.base.types import F64, I64
from hilctl.identify.data.cycles import average_cycle
from hilctl.identify.data.records import SteadyLoop
from hilctl.identify.fit_api import FitData
from hilctl.models.base import HysteresisModel
from hilctl.models.plays import PlayModel
from hilctl.recording.recording import Recording, Ticks

RATE_HZ = 50_000.0


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
def recording_of() -> Callable[..., Recording]:
    """Return a function that wraps signals and segments into a recording."""

    def make(
        command: F64,
        displacement_um: F64,
        segments: Sequence[Segment],
        *,
        rate_hz: float = RATE_HZ,
        index: I64 | None = None,
    ) -> Recording:
        n = command.size
        nothing = np.zeros(0, dtype=np.int64)
        samples = Samples(
            index=np.arange(n, dtype=np.int64) if index is None else index,
            reference_um=np.full(n, np.nan),
            wanted=command,
            command=command,
            displacement_um=displacement_um,
            input_um=np.full(n, np.nan),
            flags=np.zeros(n, dtype=np.uint32),
        )
        return Recording(
            path=Path("grid.mcap"),
            run={},
            end={},
            sample_rate_hz=rate_hz,
            command_unit="A",
            compensated=False,
            segments=tuple(segments),
            samples=samples,
            dropped=0,
            ticks=Ticks(nothing, nothing, nothing, nothing),
            events=(),
            experiment_yaml="",
            model_yaml="",
        )

    return make


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
