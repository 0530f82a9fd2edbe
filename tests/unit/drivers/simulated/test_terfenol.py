"""The simulated actuator's physics, against the published figures and against itself."""

import json
import math
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from itertools import pairwise
from typing import ClassVar

import numpy as np
import pytest
from pydantic import ValidationError
from scipy.signal import StateSpace, lsim

from hilctl.base.device import VoltageLimit
from hilctl_drivers.simulated import terfenol
from hilctl_drivers.simulated.devices import SimulatedTerfenol, TerfenolOptions
from hilctl_drivers.simulated.pinned_cells import PinnedCellsParameters
from tests.rigs.devices import OTHER_RODS
from tests.unit.drivers.simulated.test_actuator_base import hysteresis_percent, run

RATED = terfenol.TerfenolParameters()
QUIET = replace(RATED, sensor_noise_um=0.0)
RATE_HZ = 50e3


@cache
def last_cycle(harmonics, frequency_hz, bias_a=0.0):
    """Command in A and displacement in um of the last cycle of sum of a sin(k w t)."""
    # A slow loop changes little in a sample, and the internal step is the same at any rate.
    rate_hz = RATE_HZ if frequency_hz > 10.0 else 2500.0
    n = round(rate_hz / frequency_hz)
    cycles = 2 if frequency_hz < 50.0 else 8
    phase = 2.0 * np.pi * np.arange(n * cycles) / n
    command_a = np.sum([a * np.sin(k * phase) for k, a in harmonics], axis=0)
    displacement_um = run(terfenol.TerfenolActuator(QUIET, rate_hz, bias_a=bias_a), command_a)
    return command_a[-n:], displacement_um[-n:]


def sine(amplitude_a, frequency_hz, bias_a=0.0):
    return last_cycle(((1, amplitude_a),), frequency_hz, bias_a)


def stroke_um(amplitude_a, frequency_hz):
    return float(np.ptp(sine(amplitude_a, frequency_hz)[1]))


def hysteresis(amplitude_a, frequency_hz):
    return hysteresis_percent(*sine(amplitude_a, frequency_hz))


def asymmetry_percent(amplitude_a):
    _, displacement_um = sine(amplitude_a, 10.0)
    difference_um = -displacement_um.min() - displacement_um.max()
    return float(100.0 * difference_um / np.ptp(displacement_um))


def minor_loop_um(first_a, third_a, frequency_hz, side):
    """Peak-to-peak displacement of the minor loop at the input's maximum (1) or minimum (-1)."""
    command_a, displacement_um = last_cycle(((1, first_a), (3, third_a)), frequency_hz)
    rising = np.diff(np.append(command_a, command_a[0])) > 0.0
    turns = np.flatnonzero(rising != np.roll(rising, 1))
    excursions = []
    for a, b in zip(turns, np.roll(turns, -1), strict=True):
        span = np.arange(a, (b if b > a else b + command_a.size) + 1) % command_a.size
        extent_a = abs(command_a[b] - command_a[a])
        middle_a = 0.5 * (command_a[a] + command_a[b])
        excursions.append((extent_a, middle_a, np.ptp(displacement_um[span])))
    minor = sorted(excursions)[:4]  # the two that are left carry it from end to end
    return float(np.mean([um for _, middle_a, um in minor if middle_a * side > 0.0]))


PUBLISHED: list[tuple[str, float, float, Callable[[], float]]] = [
    ("stroke 6 A 1 Hz, um", 83.1, 8.31, lambda: stroke_um(6.0, 1.0)),
    ("stroke 7 A 10 Hz, um", 100.0, 10.0, lambda: stroke_um(7.0, 10.0)),
    ("stroke 2.3 A 1 Hz, um", 25.8, 2.58, lambda: stroke_um(2.3, 1.0)),
    ("hysteresis 6 A 1 Hz, %", 18.2, 1.82, lambda: hysteresis(6.0, 1.0)),
    ("hysteresis 6 A 250 Hz, %", 49.1, 0.98, lambda: hysteresis(6.0, 250.0)),
    ("hysteresis 2.3 A 1 Hz, %", 18.0, 1.80, lambda: hysteresis(2.3, 1.0)),
    ("hysteresis 2.3 A 100 Hz, %", 25.7, 2.57, lambda: hysteresis(2.3, 100.0)),
    ("asymmetry 3 A 10 Hz, %", 6.4, 5.0, lambda: asymmetry_percent(3.0)),
    ("asymmetry 9 A 10 Hz, %", 17.31, 1.73, lambda: asymmetry_percent(9.0)),
    ("minor loop (4, 3) A 20 Hz top, um", 18.0, 1.8, lambda: minor_loop_um(4, 3, 20.0, 1)),
    ("minor loop (4, 3) A 20 Hz bottom, um", 26.0, 2.6, lambda: minor_loop_um(4, 3, 20.0, -1)),
    ("minor loop (3, 4) A 20 Hz top, um", 34.0, 3.4, lambda: minor_loop_um(3, 4, 20.0, 1)),
    ("minor loop (3, 4) A 50 Hz top, um", 34.0, 3.4, lambda: minor_loop_um(3, 4, 50.0, 1)),
    ("minor loop (3, 4) A 100 Hz top, um", 34.0, 3.4, lambda: minor_loop_um(3, 4, 100.0, 1)),
    ("minor loop (3, 4) A 20 Hz bottom, um", 42.0, 4.2, lambda: minor_loop_um(3, 4, 20.0, -1)),
    ("minor loop (3, 4) A 50 Hz bottom, um", 42.0, 4.2, lambda: minor_loop_um(3, 4, 50.0, -1)),
    ("minor loop (3, 4) A 100 Hz bottom, um", 42.0, 4.2, lambda: minor_loop_um(3, 4, 100.0, -1)),
]


class TestPublishedFigures:
    """Figures 2.4 to 2.14, 4.2, 4.5, 5.5 and 6.3 of the dissertation that the rig stands for."""

    @pytest.mark.parametrize(
        ("name", "published", "tolerance", "figure"), PUBLISHED, ids=[row[0] for row in PUBLISHED]
    )
    def test_figure(self, name, published, tolerance, figure):
        simulated = figure()
        print(f"{name}: {simulated:.2f}, published {published:g}")
        assert simulated == pytest.approx(published, abs=tolerance)

    def test_loop_area_is_linear_in_frequency(self):
        """At 6 A the area of the loop grows in proportion to the frequency, r^2 >= 0.99."""
        frequencies_hz = [10.0, 50.0, 100.0, 150.0, 200.0, 250.0]
        areas = []
        for frequency_hz in frequencies_hz:
            command_a, displacement_um = sine(6.0, frequency_hz)
            slope_a = 0.5 * (np.roll(command_a, -1) - np.roll(command_a, 1))
            areas.append(abs(float(np.dot(displacement_um, slope_a))))
        assert np.corrcoef(frequencies_hz, areas)[0, 1] ** 2 >= 0.99
        assert areas == sorted(areas)

    def test_more_bias_gives_less_stroke_and_area(self):
        """From 30 to 60 kA/m of bias field, stroke and loop area of a 3 A sine fall."""
        strokes, areas = [], []
        for bias_field in (30e3, 45e3, 60e3):
            bias_a = (bias_field - RATED.magnet_field_a_per_m) / RATED.coil_factor_per_m
            command_a, displacement_um = sine(2.965, 10.0, bias_a)
            strokes.append(np.ptp(displacement_um))
            areas.append(abs(np.dot(displacement_um, np.gradient(command_a))))
        assert strokes == sorted(strokes, reverse=True)
        assert areas == sorted(areas, reverse=True)

    @pytest.mark.parametrize("load_kg", [0.0, 3.7, 9.2, 14.7])
    def test_load_lowers_the_resonance(self, load_kg):
        """A 0.1 A step rings at sqrt(stiffness / (moving mass + load))."""
        mass_kg = RATED.moving_mass_kg + load_kg
        damped = np.sqrt(RATED.stiffness_n_per_m / mass_kg * (1.0 - RATED.damping_ratio**2))
        # Far less lag than rated, and no current loop to speak of: the ringing stands alone.
        rods = replace(PinnedCellsParameters(), lag_s=1e-5)
        brisk = replace(QUIET, rods=rods, amplifier_bandwidth_hz=50e3, dac_codes=2**30)
        ringing = run(terfenol.TerfenolActuator(brisk, 200e3, load_kg), np.full(20_000, 0.1))
        ringing -= ringing[-1]
        crossings = np.flatnonzero(np.diff(np.sign(ringing)))[:5]
        half_period_s = np.diff(crossings).mean() / 200e3
        assert np.pi / half_period_s == pytest.approx(damped, rel=0.02)


def test_noise_is_the_sensors():
    """The reading at rest has the published noise and no mean."""
    displacement_um = run(terfenol.TerfenolActuator(RATED, RATE_HZ), np.zeros(50_000))
    assert displacement_um.std() == pytest.approx(0.03553, rel=0.02)
    assert abs(displacement_um.mean()) < 0.001


class TestTiming:
    def test_reading_comes_before_the_command(self):
        """The first reading cannot show the first command, neither as current nor as motion."""
        displacement_um, current_a = np.empty(50), np.empty(50)
        terfenol.TerfenolActuator(QUIET, RATE_HZ).step(np.full(50, 2.0), displacement_um, current_a)
        assert displacement_um[0] == 0.0
        assert current_a[0] == 0.0
        assert current_a[1] == pytest.approx(2.0 * (1.0 - np.exp(-2e4 * np.pi * 20e-6)), abs=1e-3)
        assert displacement_um[-1] > 1.0

    def test_sensor_stops_at_its_range(self):
        """A displacement beyond +-10 V of sensor output reads as the end of the range."""
        strong = replace(QUIET, rods=replace(PinnedCellsParameters(), strain_um=1500.0))
        displacement_um = run(
            terfenol.TerfenolActuator(strong, RATE_HZ), np.repeat([-9.0, 9.0], 1000)
        )
        assert displacement_um.min() == -125.0
        assert displacement_um.max() == 125.0


EVERYTHING = {
    "creep": {"share": 0.03},
    "thermal": {"rise_k_per_a2": 0.5, "tau_s": 60.0, "growth_um_per_k": 0.3, "ambient_k": -10.0},
    "second_mode": {"frequency_hz": 900.0, "damping_ratio": 0.02, "share": 0.05},
    "amplifier": {"voltage_max_v": 90.0, "resistance_ohm": 4.0, "inductance_h": 3e-3},
}


def options(**given):
    return TerfenolOptions.model_validate({"noise": False, **given})


def actuator(rate_hz=RATE_HZ, chosen=TerfenolOptions, **given):
    of = chosen.model_validate({"noise": False, **given})
    return terfenol.TerfenolActuator(of.parameters(), rate_hz, of.load_kg, of.bias_a)


def run_both(rig, command_a):
    displacement_um, current_a = np.empty((2, command_a.size))
    rig.step(command_a, displacement_um, current_a)
    return displacement_um, current_a


@pytest.mark.parametrize("chosen", [TerfenolOptions, *OTHER_RODS])
def test_cut_does_not_matter(chosen):
    """With everything at once, readings are the same bit for bit wherever blocks are cut."""
    command_a = np.random.default_rng(7).uniform(-7.0, 7.0, 60).repeat(50)
    whole = run_both(actuator(chosen=chosen, **EVERYTHING), command_a)[0]
    rig = actuator(chosen=chosen, **EVERYTHING)
    cut = [run_both(rig, part)[0] for part in np.split(command_a, [1, 2, 50, 777, 2990])]
    np.testing.assert_array_equal(np.concatenate(cut), whole)
    rig.reset()
    np.testing.assert_array_equal(run_both(rig, command_a)[0], whole)


def test_details_hold_what_was_asked_for():
    """A recording says what rig it was."""
    details = SimulatedTerfenol(options(**EVERYTHING)).info.details
    assert "voltage_max_v" in json.loads(details["amplifier"])
    assert float(details["lag_s"]) == PinnedCellsParameters().lag_s
    assert SimulatedTerfenol(TerfenolOptions()).info.details["creep"] == "null"


class TestCreep:
    def test_grows_with_the_logarithm_of_time(self):
        """After a step, each decade of time adds about the same; in the end it is the share."""
        option = {"share": 0.04, "time_constants_s": (0.003, 0.03, 0.3, 3.0)}
        crept, plain = (
            run_both(actuator(1000.0, **given), np.full(12_000, 5.0))[0]
            for given in ({"creep": option}, {})
        )
        share = (crept / plain[-1] - 1.0)[[15, 150, 1500, 11_999]]
        np.testing.assert_allclose(np.diff(share)[:2], 0.01, rtol=0.2)
        assert share[-1] == pytest.approx(0.04, rel=0.02)

    def test_is_its_own_transfer_function(self):
        """The elements are first-order lags of what moves without them."""
        command_a = np.random.default_rng(2).uniform(-5.0, 5.0, 30).repeat(100)
        option = {"share": 0.2, "time_constants_s": (0.005, 0.05)}
        crept = run_both(actuator(creep=option), command_a)[0]
        plain = run_both(actuator(), command_a)[0]
        lags = np.array([0.005, 0.05])
        filtered = StateSpace(-np.diag(1.0 / lags), 1.0 / lags[:, None], [[0.1, 0.1]], [[1.0]])
        time_s = np.arange(command_a.size) / RATE_HZ
        np.testing.assert_allclose(crept, lsim(filtered, plain, time_s)[1], atol=0.05)

    @pytest.mark.parametrize("times", [(), (0.0,), (1.0,) * 9])
    def test_refuses(self, times):
        with pytest.raises(ValidationError, match="time_constants_s"):
            options(creep={"share": 0.1, "time_constants_s": times})


class TestThermal:
    def test_room_moves_the_rest_position(self):
        """From the first reading, without any motion of the structure."""
        thermal = {"rise_k_per_a2": 0.0, "tau_s": 1.0, "growth_um_per_k": 0.5, "ambient_k": -10.0}
        reading = run_both(actuator(thermal=thermal), np.zeros(100))[0]
        np.testing.assert_allclose(reading, -5.0, atol=0.002)

    def test_coil_warms_by_its_square(self):
        """A sine and a steady current of its effective value warm alike, by their time constant."""
        thermal = {"rise_k_per_a2": 0.5, "tau_s": 0.5, "growth_um_per_k": 1.0}
        time_s = np.arange(2000) / 1000.0
        sine = 4.0 * np.sin(2.0 * np.pi * 50.0 * time_s)
        grown = [
            run_both(actuator(1000.0, thermal=thermal), command_a)[0]
            - run_both(actuator(1000.0), command_a)[0]
            for command_a in (sine, np.full(2000, 4.0 / np.sqrt(2.0)))
        ]
        expected = 0.5 * 8.0 * -np.expm1(-time_s / 0.5)
        np.testing.assert_allclose(grown[1], expected, atol=0.02)
        np.testing.assert_allclose(grown[0], expected, atol=0.05)

    def test_bias_warms_too(self):
        """A coil that carries the bias warms at rest."""
        thermal = {"rise_k_per_a2": 0.5, "tau_s": 0.1, "growth_um_per_k": 1.0}
        reading = run_both(actuator(1000.0, thermal=thermal, bias_a=-2.0), np.zeros(1000))[0]
        assert reading[-1] == pytest.approx(2.0, abs=0.01)


class TestSecondMode:
    def test_static_displacement_stays(self):
        """The second mode's share is taken from the first."""
        mode = {"frequency_hz": 900.0, "damping_ratio": 0.05, "share": 0.1}
        held = [
            run_both(actuator(**given), np.full(5000, 3.0))[0][-1]
            for given in ({}, {"second_mode": mode})
        ]
        assert held[1] == pytest.approx(held[0], abs=0.004)

    def test_rings_at_its_own_frequency(self):
        """What a step leaves of two modes less the first alone is the second's decay."""
        mode = {"frequency_hz": 700.0, "damping_ratio": 0.02, "share": 0.3}
        rods = replace(PinnedCellsParameters(), lag_s=1e-6)
        brisk = replace(
            options(second_mode=mode).parameters(), rods=rods, dac_codes=2**30, damping_ratio=0.9
        )
        ringing = run_both(terfenol.TerfenolActuator(brisk, 200e3), np.full(40_000, 0.2))[0]
        ringing = ringing[400:] - ringing[-1]
        crossings = np.flatnonzero(np.diff(np.sign(ringing)))[:9]
        half_period_s = np.diff(crossings).mean() / 200e3
        assert 0.5 / half_period_s == pytest.approx(700.0, rel=0.01)
        peaks = [np.abs(ringing[a:b]).max() for a, b in pairwise(crossings)]
        decay = np.mean(np.diff(np.log(peaks))) / np.pi
        assert -decay == pytest.approx(0.02, rel=0.05)


STEP = np.full(200, 0.5)


class TestVoltageLimit:
    LIMIT: ClassVar = {"voltage_max_v": 60.0, "resistance_ohm": 4.0, "inductance_h": 5e-3}

    def test_step_rises_as_the_voltage_drives_it(self):
        """A large step follows V / R (1 - exp(-R t / L)) until it is nearly there, then settles."""
        current_a = run_both(actuator(amplifier=self.LIMIT), np.full(200, 9.0))[1]
        time_s = np.arange(200) / RATE_HZ
        driven = 15.0 * -np.expm1(-time_s * 4.0 / 5e-3)
        rising = driven < 8.0
        np.testing.assert_allclose(current_a[rising], driven[rising], atol=4e-4)
        assert current_a.max() <= 9.0002
        assert current_a[-1] == pytest.approx(9.0, abs=4e-4)

    def test_falls_faster_than_it_rises(self):
        """The resistance adds to the voltage on the way back."""
        command_a = np.repeat([9.0, 0.0], 200)
        current_a = run_both(actuator(amplifier=self.LIMIT), command_a)[1]
        assert 9.0 - current_a[210] > 1.5 * current_a[10]

    def test_the_voltage_of_a_driven_current_is_the_largest(self):
        limit = VoltageLimit.model_validate(self.LIMIT)
        decay = limit.decay(1e-3)
        current_a = np.array([2.0, 2.0 * decay + limit.held_a * (1.0 - decay)])
        assert limit.voltage_v(current_a, 1e-3) == pytest.approx([60.0])

    def test_bandwidth_is_that_of_the_current_loop(self):
        current_a = run_both(actuator(amplifier=self.LIMIT | {"bandwidth_hz": 100.0}), STEP)[1]
        time_s = np.arange(STEP.size) / RATE_HZ
        expected_a = STEP[0] * -np.expm1(-2.0 * np.pi * 100.0 * time_s)
        np.testing.assert_allclose(current_a, expected_a, atol=4e-4)

    def test_small_signals_do_not_notice(self):
        """Where the voltage suffices the current is the unlimited one, bit for bit."""
        command_a = 0.5 * np.sin(np.arange(2000) / 40.0)
        for one, other in zip(
            run_both(actuator(amplifier=self.LIMIT), command_a),
            run_both(actuator(), command_a),
            strict=True,
        ):
            np.testing.assert_array_equal(one, other)


CODE_A = 1e-3
NO_LIMIT = math.inf


def amplified(command, left=0.5, decay=0.9, most=NO_LIMIT, substeps=2):
    """Return readings and the currents of all half steps, from 0 A."""
    command = np.asarray(command, dtype=float)
    read, halves = np.empty(command.size), np.empty(2 * command.size * substeps + 1)
    factors = (math.sqrt(left), left, math.sqrt(decay), decay, most, CODE_A)
    terfenol.amplify(command, read, halves, np.zeros(1), factors, substeps)
    return read, halves


def test_commands_and_readings_are_whole_codes():
    read, halves = amplified([0.00149, 0.00151], left=0.0)
    assert halves[[2, -1]] == pytest.approx([0.001, 0.002])
    assert read[1] == pytest.approx(0.001)
