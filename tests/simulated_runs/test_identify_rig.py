"""Models identified on the simulated magnetostrictive rig, which none of them is.

No public measured current-to-displacement record of a magnetostrictive actuator is known, so these
figures rest on the simulation; those beside them are of the dissertation's own rig.
"""

from collections.abc import Sequence
from functools import cache
from typing import Any

import numpy as np
import pytest

from hilctl.lab.identify.data.records import SteadyLoop
from hilctl.lab.identify.evaluation import judge
from hilctl.lab.identify.fit_api import FitRequest
from hilctl.lab.identify.fit_model import FittedModel, fit_model
from hilctl.lab.identify.settings import FitSettings
from hilctl.signals.cycle_metrics import fold, peak_hysteresis_percent
from hilctl_drivers.simulated.terfenol import TerfenolParameters
from tests.rig import RATE_HZ, driven, steady_loop

measured_loop = cache(steady_loop)


def sines(
    amplitudes: Sequence[float], frequencies: Sequence[float], points: int
) -> list[SteadyLoop]:
    return [measured_loop((a, f), points=points) for a in amplitudes for f in frequencies]


def fit(kind: str, data: list[SteadyLoop], **choices: Any) -> FittedModel:
    return fit_model(FitRequest(data, FitSettings(kind=kind, **choices)))


@cache
def published_omega() -> FittedModel:
    """Return Omega, 12 plays and 17 deadbands, on the published grid (6.24)."""
    return fit("integrated", sines([3.0, 6.0], [10.0, 50.0, 100.0, 150.0, 250.0], 300))


@cache
def omega_36() -> FittedModel:
    """Return Omega with 36 plays on the same grid."""
    data = sines([3.0, 6.0], [10.0, 50.0, 100.0, 150.0, 250.0], 300)
    return fit("integrated", data, plays=36, starts=3)


def test_omega_meets_the_published_error_on_the_published_grid() -> None:
    """The peak error is at most 3.72 %, of the largest and of each loop's own peak-to-peak."""
    found = published_omega()
    assert found.peak_percent <= 3.0
    assert found.own_peak_percent <= 3.72
    assert found.rms_percent <= 0.65
    assert found.model.operators == 12
    assert found.model.input_range == pytest.approx((-6.0, 6.0), abs=1e-3)


def test_starts_end_at_the_same_error() -> None:
    """As published, different starting values end at nearly the same errors."""
    ends = [start.rms_percent for start in published_omega().starts]
    assert max(ends) <= 1.1 * min(ends)


def test_omega_holds_for_other_inputs() -> None:
    """Loops that were not fitted, 5 A and the two complex inputs (6.4), are met nearly as well."""
    others = [
        *sines([5.0], [1.0, 10.0, 150.0, 250.0], 300),
        measured_loop((1.0, 50.0), (5.0, 100.0)),
        measured_loop((1.0, 100.0), (5.0, 200.0)),
    ]
    tried = judge(published_omega().model, others)
    assert tried.own_peak_percent <= 3.72


def test_omega_at_full_rate_is_as_good_as_on_its_loops() -> None:
    """Run sample by sample at 50 kHz, the model is as near to the rig as the loops said."""
    time = np.arange(round(6.0 / 250.0 * RATE_HZ)) / RATE_HZ
    command = np.clip(time * 250.0, 0.0, 1.0) * 6.0 * np.sin(2.0 * np.pi * 250.0 * time)
    displacement_um = driven(command)
    modelled_um = published_omega().model.forward(RATE_HZ).process(command)
    steady = slice(round(2.0 * RATE_HZ / 250.0), None)
    error_um = (modelled_um - displacement_um)[steady]
    peak_percent = 100.0 * np.max(np.abs(error_um)) / np.ptp(displacement_um[steady])
    (on_loop,) = (e for e in published_omega().errors if e.label == "6 A 250 Hz")
    assert peak_percent == pytest.approx(on_loop.peak_percent, abs=0.5)


def test_free_weights_and_more_plays_are_better() -> None:
    """36 plays and free weights each lower the peak error, as published for 36 plays."""
    data = sines([3.0, 6.0], [10.0, 50.0, 100.0, 150.0, 250.0], 300)
    free = fit("integrated", data, weights="free", starts=2)
    assert omega_36().peak_percent < published_omega().peak_percent
    assert free.peak_percent <= 1.9


@cache
def staged() -> FittedModel:
    """Return the staged model of a short campaign."""
    tones = [(3.0, 1.0), (3.0, 250.0), (5.0, 100.0), (6.6, 1.0), (6.6, 50.0), (6.6, 100.0)]
    data = [measured_loop(tone) for tone in (*tones, (6.6, 150.0), (6.6, 250.0), (6.0, 400.0))]
    return fit("staged", data)


def test_staged_model_finds_lag_and_resonance() -> None:
    """From loops alone, lag and resonance come within 10 % of what the rig was built with."""
    rig, found = TerfenolParameters(), staged()
    assert found.parameters["tau_s"] == pytest.approx(rig.rods.lag_s, rel=0.1)
    growth = rig.rods.lag_growth_m_per_a * rig.coil_factor_per_m
    assert found.parameters["growth_per_unit"] == pytest.approx(growth, rel=0.1)
    assert found.parameters["natural_hz"] == pytest.approx(2292.0, rel=0.1)
    assert found.peak_percent <= 0.8


def compensated(frequency_hz: float) -> tuple[float, float]:
    """Return peak hysteresis and peak error in percent, the full stroke through the inverse."""
    period = RATE_HZ / frequency_hz
    time = np.arange(round(8 * period)) / RATE_HZ
    swell = 0.5 - 0.5 * np.cos(np.pi * np.clip(time * frequency_hz / 3.0, 0.0, 1.0))
    reference_um = swell * (40.8 * np.sin(2.0 * np.pi * frequency_hz * time) - 6.9)
    inverse = staged().model.inverse(RATE_HZ)
    ahead = np.append(reference_um[inverse.preview :], np.full(inverse.preview, reference_um[-1]))
    command = inverse.process(ahead)
    displacement_um = driven(command, seed=11)
    index = np.arange(time.size)[-round(4 * period) :]
    cycle = fold(index, period, (reference_um[index], displacement_um[index]))
    error = np.max(np.abs(cycle.signals[1] - cycle.signals[0]))
    hysteresis = peak_hysteresis_percent(*cycle.signals)
    assert hysteresis is not None
    return hysteresis, 100.0 * float(error) / float(np.ptp(cycle.signals[1]))


@pytest.mark.parametrize("frequency_hz", [5.0, 50.0, 100.0, 200.0, 250.0])
def test_staged_inverse_straightens_the_rig(frequency_hz: float) -> None:
    """At full stroke, noise not seen before, hysteresis is at most 1 % (published: up to 3.7 %)."""
    hysteresis, error = compensated(frequency_hz)
    assert hysteresis <= 1.0
    assert error <= 1.0


@cache
def chapter_4() -> list[SteadyLoop]:
    """Return the grid of (4.9)."""
    return sines([3.0, 7.0], [10.0, 100.0, 200.0], 200)


@cache
def omega_10() -> FittedModel:
    """Return Omega with 10 plays on that grid."""
    return fit("integrated", chapter_4(), plays=10, starts=3)


def test_without_rate_or_deadbands_the_model_is_far_off() -> None:
    """Figure 4.14, 5 and 7 A at 200 Hz: published 13.5 % without rate, 9.6 % without deadbands.

    Here 11.5 and 11.3 %, against 2.8 % (published 3.72) of Omega.
    """
    others = sines([5.0, 7.0], [200.0], 200)
    omega = judge(omega_10().model, others)
    no_rate = judge(fit("asymmetric", chapter_4(), plays=10).model, others)
    choices = {"plays": 10, "weights": "exponential", "weight_by": "equal", "starts": 3}
    no_deadbands = judge(fit("rdpi", chapter_4(), **choices).model, others)
    assert omega.own_peak_percent <= 3.72
    assert no_rate.own_peak_percent == pytest.approx(11.5, abs=1.0)
    assert no_deadbands.own_peak_percent == pytest.approx(11.3, abs=1.0)


def test_error_against_number_of_plays() -> None:
    """Figure 4.10: the error falls with n, by little beyond 8 (rms 0.96, 0.75, 0.64, 0.59 %)."""
    rms = [fit("integrated", chapter_4(), plays=n, starts=3).rms_percent for n in (2, 4, 8, 15)]
    assert rms == pytest.approx([0.96, 0.75, 0.64, 0.59], abs=0.03)


def test_more_plays_bring_little_at_6_a() -> None:
    """Section 6.3: 6 A, 250 Hz, 3.68 % with 12 plays and 3.27 % with 36; here 2.8 and 2.3 %."""
    peaks = []
    for found in (published_omega(), omega_36()):
        (error,) = (e for e in found.errors if e.label == "6 A 250 Hz")
        peaks.append(error.peak_percent)
    assert peaks == pytest.approx([2.8, 2.3], abs=0.2)


def test_areas_of_the_loops() -> None:
    """Published: 0.12 to 0.96 % off at 7 A. Here Omega is 4.4 % off, with its stages 0.8 %."""
    loops = sines([7.0], [10.0, 50.0, 100.0, 150.0, 200.0], 200)

    def largest(found: FittedModel) -> float:
        return max(
            abs(error.area_error_percent or 0.0) for error in judge(found.model, loops).errors
        )

    assert largest(fit("staged", chapter_4(), plays=10, deadbands=8)) <= 0.96
    assert largest(omega_10()) <= 4.7


def test_rdpi_at_small_amplitude() -> None:
    """At 2.3 A, 1 to 200 Hz, weighted by hysteresis, n = 4 gives thresholds near the published.

    Published: alpha = 0.309 A, gamma = 2.73e-4 s. The rig is asymmetric even there, so a constant
    displacement takes off much of the error.
    """
    data = sines([2.3], [1.0, 50.0, 100.0, 200.0], 400)
    plain = fit("rdpi", data)
    offset = fit("rdpi", data, offset=True)
    assert plain.parameters["alpha"] == pytest.approx(0.309, rel=0.2)
    assert plain.parameters["gamma"] == pytest.approx(2.73e-4, rel=0.25)
    assert plain.peak_percent <= 6.0
    assert offset.peak_percent <= 3.72
