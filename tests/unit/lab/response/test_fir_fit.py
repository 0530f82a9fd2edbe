"""Fit of an FIR to a measured response."""

import numpy as np
import pytest

from hilctl.experiment.sections.coupling import CrosstalkFilter
from hilctl.lab.response.fir_fit import fit_fir
from hilctl.models.linear_stages import second_order

RATE_HZ = 50e3
HZ = np.arange(1, 257) * 1.5625


def mode(natural_hz, damping_ratio=0.05, gain=0.04):
    return gain / second_order(HZ, natural_hz, damping_ratio)


def noisy(response, noise):
    rng = np.random.default_rng(1)
    parts = rng.standard_normal((2, HZ.size)) * noise / np.sqrt(2.0)
    return response + parts[0] + 1j * parts[1]


def rms(values):
    return np.sqrt(np.mean(np.abs(values) ** 2))


def applied(fit):
    """Return the response of the taps as a coupling applies them."""
    through = CrosstalkFilter(
        first_sample=fit.first_sample, spacing=fit.spacing, taps=tuple(fit.taps), coherence=1.0,
        noise_percent=0.0, residual_percent=0.0,
    )  # fmt: skip
    values, first = through.response()
    turns = np.outer(HZ, np.arange(values.size) + first) / RATE_HZ
    return np.exp(-2j * np.pi * turns) @ values


@pytest.mark.parametrize("noise", [0.0, 1e-3])
def test_static_crosstalk_is_one_tap(noise):
    fit = fit_fir(HZ, noisy(np.full(HZ.size, 0.04), noise), np.full(HZ.size, noise), RATE_HZ)
    assert (fit.first_sample, fit.spacing) == (0, 1)
    assert fit.taps == pytest.approx([0.04], abs=1e-4)


@pytest.mark.parametrize("noise", [0.0, 1e-3])
@pytest.mark.parametrize("natural_hz", [120.0, 180.0, 600.0])
def test_mode_is_described_by_a_few_taps(natural_hz, noise):
    true = mode(natural_hz)
    fit = fit_fir(HZ, noisy(true, noise), np.full(HZ.size, noise), RATE_HZ)
    assert fit.taps.size <= 256
    assert fit.first_sample < 0
    assert rms(applied(fit) - true) < 0.03 * rms(true)
    slow = HZ < 50.0
    assert rms((applied(fit) - true)[slow]) < 0.04 * rms(true[slow])


def test_residuals_say_what_is_left_out_of_the_fit():
    """Lines without a common FIR have the residual of a fit without them: as large as they are."""
    rng = np.random.default_rng(2)
    scattered = np.exp(2j * np.pi * rng.random(HZ.size))
    fit = fit_fir(HZ, scattered, np.full(HZ.size, 1e-3), RATE_HZ)
    assert rms(fit.residuals) > 0.9


def test_lines_with_noise_count_less():
    true, noise = np.full(HZ.size, 0.04) + 0j, np.full(HZ.size, 1e-5)
    noise[::2] = 1.0
    off = true.copy()
    off[::2] += 0.5
    assert fit_fir(HZ, off, noise, RATE_HZ).taps[0] == pytest.approx(0.04, abs=1e-3)
