"""Stop operators against the published plays they undo (3.11-3.24)."""

import numpy as np
import pytest

from hilctl.models.spi import SpiModel
from tests.published import piezo_ppi

SAMPLE_RATE_HZ = 50_000.0
SPI_DIRECT = 2.146
SPI_THRESHOLDS = (
    0.9108, 1.9418, 3.0797, 4.3122, 5.6285, 7.0194, 8.4762, 9.9915, 11.5587, 13.1716,
)  # fmt: skip
SPI_WEIGHTS = (
    0.4544, 0.3230, 0.2397, 0.1831, 0.1444, 0.1156, 0.0941, 0.0774, 0.0642, 0.0543,
)  # fmt: skip


def sine(amplitude, frequency_hz, cycles=3):
    n = round(cycles * SAMPLE_RATE_HZ / frequency_hz)
    return amplitude * np.sin(2 * np.pi * frequency_hz * np.arange(n) / SAMPLE_RATE_HZ)


def spi(ppi):
    """Return the same PPI, compensated by stops."""
    return SpiModel(**ppi.model_dump(exclude={"kind"}))


def test_spi_direct_weight_from_the_published_ppi():
    """w_0 from the published PPI is the published one."""
    assert spi(piezo_ppi()).stop_parameters()[0] == pytest.approx(SPI_DIRECT, abs=0.002)


@pytest.mark.parametrize("i", range(10))
def test_spi_from_the_published_ppi(i):
    """Each threshold and weight is the published one, within its inputs' rounding."""
    _, weights, thresholds = spi(piezo_ppi()).stop_parameters()
    assert thresholds[i] == pytest.approx(SPI_THRESHOLDS[i], abs=0.002)
    assert weights[i] == pytest.approx(SPI_WEIGHTS[i], abs=0.002)


def test_spi_weights_solve_the_published_equations():
    """sum_j min(s_i, s_j) w_j + s_i w_0 = r_i (3.19), s the initial loading curve at r (3.18)."""
    ppi = piezo_ppi()
    direct, weights, thresholds = spi(ppi).stop_parameters()
    r, p = np.array((0.0, *ppi.thresholds)), np.array((ppi.direct, *ppi.weights))
    loading = np.maximum(0.0, r[1:, None] - r[None, :]) @ p
    np.testing.assert_allclose(thresholds, loading, rtol=1e-13)
    left = np.minimum.outer(thresholds, thresholds) @ weights + thresholds * direct
    np.testing.assert_allclose(left, ppi.thresholds, rtol=1e-12)


@pytest.mark.parametrize("seed", range(8))
def test_spi_is_the_inverse_ppi(seed):
    """On any signal, offset or not, both operators put out the same to 1e-12."""
    rng = np.random.default_rng(seed)
    y = 12.0 * rng.uniform(-1.0, 1.0, 400).repeat(3) + 0.3 * rng.standard_normal(1_200)
    ppi = piezo_ppi().model_copy(update={"output_offset_um": 1.5 * (seed % 2)})
    by_stops = spi(ppi).inverse(SAMPLE_RATE_HZ).process(y)
    by_plays = ppi.inverse(SAMPLE_RATE_HZ).process(y)
    assert np.max(np.abs(by_stops - by_plays)) <= 1e-12 * np.max(np.abs(by_plays))


def test_spi_of_a_model_without_hysteresis_is_a_gain():
    """No plays, no stops: the compensator divides by p_0."""
    ppi = piezo_ppi().model_copy(update={"weights": (), "thresholds": ()})
    y = sine(3.0, 50.0)
    command = spi(ppi).inverse(SAMPLE_RATE_HZ).process(y)
    np.testing.assert_allclose(command, y / 0.2567, rtol=1e-15)
