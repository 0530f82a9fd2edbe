"""What remains after learning: its frequencies, and its cause."""

from dataclasses import replace

import numpy as np
import pytest

from hilctl.lab.ilc.residual import residual
from hilctl.lab.ilc.update import IlcIteration, learn, refused
from tests.unit.lab.ilc.test_update import FREQUENCY, HARMONICS, IlcResponse, Plant, begun

FLOOR_UM = 1e-3
NOISE_UM = 1e-4


def error(harmonics, beyond_um=0.0):
    """Errors in um by harmonic, and more above the highest one."""
    found = np.zeros(HARMONICS + 1, dtype=complex)
    for k, size_um in harmonics.items():
        found[k] = size_um
    power = np.sum(2.0 * np.abs(found) ** 2) - np.abs(found[0]) ** 2 + beyond_um**2
    return replace(
        Plant(IlcResponse()).run(begun().next_um),
        harmonics_um=found,
        noise_um=np.full(HARMONICS + 1, NOISE_UM),
        peak_um=2.0,
        rms_um=float(np.sqrt(power)),
        floor_um=FLOOR_UM,
    )


def left(state, first, check=None):
    best = IlcIteration(begun().next_um, first, 500.0)
    return [(band.low_hz, band.high_hz, band.cause) for band in residual(state, best, check)]


def done(**more):
    """A state in which all harmonics up to 3 kHz have moved, and answered as they should."""
    plant, state = Plant(IlcResponse()), begun()
    for _ in range(6):
        (state,) = learn([state], [plant.run(state.next_um)])
    return replace(state, done="by a test", reach_hz=3000.0, **more)


def test_nothing_remains_at_the_noise_floor():
    quiet = replace(error({7: 1e-2}), peak_um=1.1 * FLOOR_UM)
    assert left(done(), quiet) == []
    # A little above it in the next run, with the same error; then with another one.
    assert left(done(), quiet, error({7: 1e-2})) == []
    assert left(done(), quiet, error({7: -1e-2})) == [(700.0, 700.0, "not_repeatable")]


def test_adjacent_harmonics_are_one_band_and_small_ones_none():
    found = error({7: 0.2, 8: 0.1, 10: 0.2, 20: 0.3, 40: 0.02})
    assert [ends[:2] for ends in left(done(), found)] == [(700.0, 1000.0), (2000.0, 2000.0)]


def test_band_has_the_rms_of_its_harmonics_in_percent():
    best = IlcIteration(begun().next_um, error({7: 0.3, 8: 0.4}), 500.0)
    (band,) = residual(done(), best, None)
    assert band.rms_percent == pytest.approx(100.0 * np.sqrt(2.0 * 0.25) / 100.0)


@pytest.mark.parametrize(("state", "cause"), [
    (done(), "coupled"),
    (replace(done(), reach_hz=500.0), "uncertain"),
    (replace(begun(), done="by a test", reach_hz=3000.0), "uncertain"),
    (replace(done(), done=""), "unfinished"),
    (refused([done()])[0], "limit"),
])  # fmt: skip
def test_cause_of_a_harmonic(state, cause):
    assert left(state, error({7: 0.2})) == [(700.0, 700.0, cause)]


def test_a_harmonic_with_another_error_in_the_next_run_does_not_repeat():
    found = left(done(), error({7: 0.2, 8: 0.2}), error({7: 0.2, 8: -0.2}))
    assert found == [(700.0, 700.0, "coupled"), (800.0, 800.0, "not_repeatable")]


def test_an_error_above_all_harmonics_is_outside():
    above = FREQUENCY[-1] + FREQUENCY[1]
    assert left(done(), error({}, beyond_um=0.5)) == [(above, 25_000.0, "outside")]


def test_an_error_without_a_clear_harmonic_is_noise():
    assert [cause for *_, cause in left(done(), error({7: NOISE_UM}))] == ["noise"]
