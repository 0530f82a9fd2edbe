"""Frequency responses of a resonator, sampled as a device samples, by each kind of excitation."""

import numpy as np
import pytest
from scipy import signal

from hilctl.base.errors import DataError, InputError
from hilctl.base.segments import Segment
from hilctl.lab.response.frequency_response import NoisyResponseError, frequency_response

RATE_HZ = 20_000.0
NATURAL_HZ, DAMPING, GAIN_UM, DELAYED = 600.0, 0.08, 4.0, 3
OMEGA = 2.0 * np.pi * NATURAL_HZ
RESONATOR = signal.cont2discrete(
    ([GAIN_UM], [OMEGA**-2, 2.0 * DAMPING / OMEGA, 1.0]), 1.0 / RATE_HZ, method="zoh"
)
B, A = np.append(np.zeros(DELAYED), RESONATOR[0][0]), RESONATOR[1]
PERIOD, PERIODS = 2000, 12  # lines at multiples of 10 Hz
N = PERIOD * PERIODS
EXCITED = np.arange(1, 160, 4)
PHASES = np.random.default_rng(1)


def segment(label, start=0, stop=N, period=0.0):
    return Segment(label, start, stop, start, stop, period)


def sines(orders, period=PERIOD, size=N):
    turns = np.outer(orders, np.arange(size)) / period
    phases = -np.pi * np.arange(len(orders)) ** 2 / len(orders)
    return 0.1 * np.sin(2.0 * np.pi * turns + phases[:, None]).sum(axis=0)


def excitation(kind):
    """Return a command and its segments."""
    t = np.arange(5 * N) / RATE_HZ
    if kind == "multisine":
        return sines(EXCITED), [segment("multisine 1 A 10-1570 Hz", period=float(PERIOD))]
    if kind == "chirp":
        wave = signal.chirp(t, 5.0, t[-1], 2000.0, "logarithmic")
        return wave, [segment("chirp 1 A 5-2000 Hz", stop=t.size)]
    if kind == "random":
        b, a = signal.butter(6, 2000.0, fs=RATE_HZ)
        wave = signal.lfilter(b, a, np.random.default_rng(2).standard_normal(t.size))
        return wave, [segment("random 1 A 5-2000 Hz seed 2", stop=t.size)]
    orders = (2, 9, 25, 45, 55, 59.5, 63, 70, 90, 120)
    parts = [
        segment(f"sine 1 A {10 * order:g} Hz", k * N, (k + 1) * N, PERIOD / order)
        for k, order in enumerate(orders)
    ]
    return np.concatenate([sines([order]) for order in orders]), parts


@pytest.fixture
def measured(make_recording):
    """Return a function that evaluates the resonator's answer to an excitation."""

    def measure(command, segments, noise_um=0.0, distorted=lambda u: u, **more):
        moved = signal.lfilter(B, A, distorted(command))
        moved += noise_um * np.random.default_rng(3).standard_normal(moved.size)
        return frequency_response(
            make_recording(
                moved, command=command, segments=segments, sample_rate_hz=RATE_HZ, **more
            )
        )

    return measure


@pytest.mark.parametrize("kind", ["multisine", "chirp", "random", "sine"])
def test_each_excitation_finds_the_resonator(measured, kind):
    """The magnitude is that of scipy's filter within 0.1 dB in the bandwidth."""
    found = measured(*excitation(kind), noise_um=1e-3)
    assert found.natural_hz == pytest.approx(NATURAL_HZ, rel=0.01)
    assert found.damping_ratio == pytest.approx(DAMPING, rel=0.05)
    assert found.gain_um == pytest.approx(GAIN_UM, rel=0.01)
    assert found.delay_s == pytest.approx(DELAYED / RATE_HZ, abs=0.5 / RATE_HZ)
    assert found.bandwidth_hz == pytest.approx(1.55 * NATURAL_HZ, rel=0.02)
    band = found.frequency_hz < found.bandwidth_hz
    assert found.coherence[band].min() > 0.99
    _, true = signal.freqz(B, A, found.frequency_hz[band], fs=RATE_HZ)
    decibels = 20.0 * np.log10(np.abs(found.response[band] / true))
    assert np.abs(decibels).max() < 0.1
    assert found.further == ()
    assert found.unit == "um/A"


def test_standard_errors_and_scatter_are_those_of_the_noise(measured):
    found = measured(*excitation("multisine"), noise_um=0.3)
    truth = {"natural_hz": NATURAL_HZ, "damping_ratio": DAMPING, "gain_um": GAIN_UM}
    for name, true in truth.items():
        assert 0.0 < abs(getattr(found, name) - true) < 4.0 * found.errors[name]
    expected = 0.3 * 2.0 / (0.1 * np.sqrt(N))
    assert np.sqrt(np.mean(found.noise**2)) == pytest.approx(expected, rel=0.2)
    np.testing.assert_allclose(np.abs(found.h2) * found.coherence, np.abs(found.response))


@pytest.mark.parametrize(
    ("distorted", "even", "odd"),
    [
        (lambda u: u, False, False),
        (lambda u: u + 0.05 * u**2, True, False),
        (lambda u: u + 0.05 * u**3, False, True),
    ],
)
def test_lines_that_are_not_excited_show_distortion(measured, distorted, even, odd):
    found = measured(*excitation("multisine"), noise_um=0.05, distorted=distorted).free
    assert (found.even_percent > 3.0 * found.noise_percent) == even
    assert (found.odd_percent > 3.0 * found.noise_percent) == odd


def test_the_fit_is_a_transfer_function_of_scipy(measured):
    found = measured(*excitation("multisine"))
    s = 2j * np.pi * found.frequency_hz
    _, answer = signal.freqresp(found.to_scipy(), s.imag)
    held = (1.0 - np.exp(-s / RATE_HZ)) / (s / RATE_HZ)
    delayed = answer * held * np.exp(-s * found.delay_s)
    np.testing.assert_allclose(delayed, found.fitted, rtol=1e-3)
    plain = found.to_mapping()
    assert plain["quality"] == pytest.approx(0.5 / DAMPING, rel=0.05)
    assert len(plain["magnitude"]) == plain["excited_lines"] == EXCITED.size


def test_a_displacement_that_falls_has_a_negative_gain(measured):
    found = measured(*excitation("multisine"), distorted=lambda u: -u)
    assert found.gain_um == pytest.approx(-GAIN_UM, rel=0.01)
    np.testing.assert_allclose(found.fitted, found.response, rtol=0.05)


def test_a_compensated_run_is_evaluated_from_its_reference(measured):
    command, segments = excitation("multisine")
    found = measured(command, segments, reference_um=GAIN_UM * command)
    assert (found.signals, found.unit) == ("reference-displacement", "um/um")
    assert found.gain_um == pytest.approx(1.0, rel=0.01)
    assert found.delay_s == pytest.approx((DELAYED + 0.5) / RATE_HZ, abs=0.5 / RATE_HZ)


@pytest.mark.parametrize("size", [PERIOD, N - 1])
def test_without_whole_periods_spectra_are_averaged(measured, size):
    period = PERIOD if size == PERIOD else PERIOD + 0.3
    part = segment("multisine 1 A 10-1570 Hz", stop=size, period=period)
    command = np.random.default_rng(4).standard_normal(size)
    assert measured(command, [part]).method == "averaged spectra"


def test_refused(measured, make_recording):
    command, segments = excitation("multisine")
    with pytest.raises(NoisyResponseError):
        measured(command, segments, noise_um=1e4)
    with pytest.raises(DataError, match="sine 1 A 20 Hz"):
        measured(command, excitation("sine")[1][:3])
    recording = make_recording(command, command=command, segments=segments)
    with pytest.raises(InputError, match="measured"):
        frequency_response(recording, "command-measured")
