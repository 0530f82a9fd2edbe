"""Runs of an actuator that differs from the model that is to be refined, in ways that are known."""

import numpy as np
import pytest

from hilctl.lab.identify.data.records import History
from hilctl.models.plays import RdpiModel
from hilctl.models.refined import RefinedModel, ResidualOperator

RATE_HZ = 10_000.0
OLD = RdpiModel(
    direct=6.0,
    weights=(1.5, 1.0, 0.5),
    thresholds=(0.5, 1.5, 3.0),
    gamma_s=0.0,
    input_range=(-7.0, 7.0),
    output_range_um=(-50.0, 50.0),
)


def actuator(slope=-0.05, offset_um=0.0, drag_um=0.8):
    """The model, then a play too few, a gain less and a drag: what no weight of its own can say."""
    cells = 4
    return RefinedModel.of(
        OLD,
        ResidualOperator(
            lowest_um=-50.0,
            cell_um=25.0,
            thresholds_um=(0.0, 6.0),
            slopes=((slope,) * cells, (0.04,) * cells),
            lengths_um=(12.0,),
            drags_um=((drag_um,) * (cells + 1), (0.0,) * (cells + 1)),
            rate_um=(0.0,) * (cells + 1),
            window_s=1e-3,
            fastest_um_per_s=2e4,
        ),
        offset_um,
    )


def command(seed, amplitude=6.5, seconds=0.5):
    """A band-limited random command from rest."""
    rng = np.random.default_rng(seed)
    t = np.arange(round(seconds * RATE_HZ)) / RATE_HZ
    phases = rng.uniform(0.0, 2.0 * np.pi, 12)
    wave = np.sum(
        [np.sin(2.0 * np.pi * f * t + p)
         for f, p in zip(rng.uniform(4.0, 80.0, 12), phases, strict=True)], axis=0,
    )  # fmt: skip
    return np.minimum(t / 0.05, 1.0) * amplitude * wave / np.abs(wave).max()


def history(truth, seed, *, noise_um=0.01, drift_um=0.0, **how):
    v = command(seed, **how)
    noise = noise_um * np.random.default_rng(1000 + seed).standard_normal(v.size)
    drift = drift_um * np.log1p(np.arange(v.size) / (0.1 * RATE_HZ))
    moved = truth.forward(RATE_HZ).process(v)
    return History(f"run {seed}", v, moved + noise + drift, RATE_HZ)


@pytest.fixture
def old():
    return OLD


def five_runs():
    """Five runs, some of them small."""
    sizes = (6.5, 6.5, 4.0, 2.0, 5.0)
    return [history(actuator(), i, amplitude=size) for i, size in enumerate(sizes)]


@pytest.fixture
def runs():
    return five_runs()
