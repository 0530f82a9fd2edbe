"""Limits, and the band that follows from the sample rate."""

import numpy as np
import pytest

from hilctl.base.errors import InputError


@pytest.mark.parametrize(
    ("rate_hz", "lowest_hz", "highest_hz"),
    [(50_000, 1.0, 400.0), (10_000, 0.5, 80.0), (1000, 0.5, 25.0), (40, 0.25, 1.0)],
)
def test_the_band_follows_from_the_sample_rate(limits_with, rate_hz, lowest_hz, highest_hz):
    """Slow devices get fewer samples per cycle to limit the duration."""
    found = limits_with(f"sample_rate_hz={rate_hz}")
    assert (found.lowest_hz, found.highest_hz) == (lowest_hz, highest_hz)
    assert found.lowest_hz < found.middle_hz < found.highest_hz


def test_a_low_slew_limit_makes_loops_slower_before_smaller(limits_with):
    """A full loop is possible at the lowest frequency, and a quarter of it at the highest."""
    found = limits_with("limits.slew_a_per_s=40.0")
    assert found.highest_hz < 25.0
    assert found.by_slew(found.reach, found.lowest_hz) == found.reach
    assert found.by_slew(found.reach, found.highest_hz) > 0.2 * found.reach
    assert "limits.slew_a_per_s" in found.note
    assert not limits_with("limits.slew_a_per_s=1e6").note


def test_the_highest_frequency_may_be_asked_for(limits_with):
    assert limits_with(highest_hz=20.0).highest_hz == 20.0
    with pytest.raises(InputError, match=r"--highest-hz .*200 Hz"):
        limits_with(highest_hz=300.0)


def test_offset_of_small_amplitudes(limits_with):
    """A unipolar drive needs an offset."""
    piezo = limits_with(
        "device={kind: simulated_piezo}", "waveform.unit=V",
        "limits={drive_v: [0.0, 100.0], slew_v_per_s: 1e4, stroke_um: [-1.0, 38.0]}",
    )  # fmt: skip
    assert limits_with().beside_rest(0.1) == 0.0
    assert 1.0 < piezo.beside_rest(1.0) < 1.1
    assert piezo.centre == 50.0
    assert piezo.centre + piezo.reach < 100.0


def test_an_amplitude_is_lowered_to_what_the_slew_leaves(limits):
    assert limits.by_slew(1.0, 10.0) == 1.0
    lowered = limits.by_slew(4.0, 400.0)
    assert 0.8 * 5000.0 < 2.0 * np.pi * 400.0 * lowered < 5000.0


def test_commands_are_scaled_to_slew_and_heat(limits_with):
    """4 A for one second exceed a budget of 1 A rms over 1 s."""
    limits = limits_with("limits.rms_current_a=1.0", "limits.thermal_time_constant_s=1.0")
    held = np.full(5000, 4.0)
    scale = limits.scale(np.concatenate((np.linspace(0.0, 4.0, 100), held)))
    heat = (4.0 * scale) ** 2 * (1.0 - np.exp(-1.0))
    assert 0.7 < heat < 1.0
    assert limits.scale(np.array([0.0, 2.0])) == pytest.approx(0.99 * 5000.0 / 10_000.0)
    assert limits.scale(np.array([0.0, 0.01])) == 1.0


def test_commands_are_scaled_to_the_voltage(limits_with):
    """4 A through 2 ohm, slowly."""
    limits = limits_with("amplifier={voltage_max_v: 4.0, resistance_ohm: 2.0, inductance_h: 1e-3}")
    assert limits.scale(np.linspace(0.0, 4.0, 50_000)) == pytest.approx(0.99 * 0.5, rel=1e-3)
