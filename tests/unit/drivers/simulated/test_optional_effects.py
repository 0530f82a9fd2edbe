"""Creep, warmth, a second mode and a limited amplifier: what a rig has where it is asked for."""

from dataclasses import replace
from itertools import pairwise
from typing import ClassVar

import numpy as np
import pytest
from pydantic import ValidationError
from scipy.signal import StateSpace, lsim

from hilctl.base.types import F64
from hilctl_drivers.simulated.devices import PHYSICS, SimulatedTerfenol, TerfenolOptions
from hilctl_drivers.simulated.pinned_cells import PinnedCellsParameters
from hilctl_drivers.simulated.terfenol import TerfenolActuator, TerfenolParameters

RATE_HZ = 50e3
EVERYTHING = {
    "creep": {"share": 0.03},
    "thermal": {"rise_k_per_a2": 0.5, "tau_s": 60.0, "growth_um_per_k": 0.3, "ambient_k": -10.0},
    "second_mode": {"frequency_hz": 900.0, "damping_ratio": 0.02, "share": 0.05},
    "amplifier": {"voltage_max_v": 90.0, "resistance_ohm": 4.0, "inductance_h": 3e-3},
}


def options(**given: object) -> TerfenolOptions:
    return TerfenolOptions.model_validate({"noise": False, **given})


def actuator(rate_hz: float = RATE_HZ, **given: object) -> TerfenolActuator:
    of = options(**given)
    return TerfenolActuator(of.parameters(), rate_hz, of.load_kg, of.bias_a)


def run(rig: TerfenolActuator, command_a: F64) -> tuple[F64, F64]:
    """Displacement in um and current in A."""
    displacement_um, current_a = np.empty((2, command_a.size))
    rig.step(command_a, displacement_um, current_a)
    return displacement_um, current_a


def run_in_parts(rig: TerfenolActuator, command_a: F64, cuts: list[int]) -> F64:
    return np.concatenate([run(rig, part)[0] for part in np.split(command_a, cuts)])


@pytest.mark.parametrize("physics", PHYSICS)
def test_cut_does_not_matter(physics: str) -> None:
    """With everything at once, readings are the same bit for bit wherever blocks are cut."""
    command_a = np.random.default_rng(7).uniform(-7.0, 7.0, 60).repeat(50)
    whole = run(actuator(physics=physics, **EVERYTHING), command_a)[0]
    rig = actuator(physics=physics, **EVERYTHING)
    cut = run_in_parts(rig, command_a, [1, 2, 50, 777, 2990])
    np.testing.assert_array_equal(cut, whole)
    rig.reset()
    np.testing.assert_array_equal(run(rig, command_a)[0], whole)


def test_details_hold_what_was_asked_for() -> None:
    """A recording says what rig it was."""
    details = SimulatedTerfenol(options(physics="diffusion", **EVERYTHING)).info.details
    assert details["physics"] == "diffusion"
    assert "voltage_max_v" in details["amplifier"]
    assert details["knee_a_per_m"] == "27000.0"
    assert "lag_s" not in details
    assert SimulatedTerfenol(TerfenolOptions()).info.details["creep"] == "None"


class TestCreep:
    """Springs and dampers in series."""

    def test_grows_with_the_logarithm_of_time(self) -> None:
        """After a step, each decade of time adds about the same; in the end it is the share."""
        option = {"share": 0.04, "time_constants_s": (0.003, 0.03, 0.3, 3.0)}
        crept, plain = (
            run(actuator(1000.0, **given), np.full(12_000, 5.0))[0]
            for given in ({"creep": option}, {})
        )
        share = (crept / plain[-1] - 1.0)[[15, 150, 1500, 11_999]]
        np.testing.assert_allclose(np.diff(share)[:2], 0.01, rtol=0.2)
        assert share[-1] == pytest.approx(0.04, rel=0.02)

    def test_is_its_own_transfer_function(self) -> None:
        """The elements are first-order lags of what moves without them."""
        command_a = np.random.default_rng(2).uniform(-5.0, 5.0, 30).repeat(100)
        option = {"share": 0.2, "time_constants_s": (0.005, 0.05)}
        crept = run(actuator(creep=option), command_a)[0]
        plain = run(actuator(), command_a)[0]
        lags = np.array([0.005, 0.05])
        filtered = StateSpace(-np.diag(1.0 / lags), 1.0 / lags[:, None], [[0.1, 0.1]], [[1.0]])
        time_s = np.arange(command_a.size) / RATE_HZ
        np.testing.assert_allclose(crept, lsim(filtered, plain, time_s)[1], atol=0.05)

    @pytest.mark.parametrize("times", [(), (0.0,), (1.0,) * 9])
    def test_refuses(self, times: tuple[float, ...]) -> None:
        with pytest.raises(ValidationError, match="time_constants_s"):
            options(creep={"share": 0.1, "time_constants_s": times})


class TestThermal:
    """Growth by temperature."""

    def test_room_moves_the_rest_position(self) -> None:
        """From the first reading, without any motion of the structure."""
        thermal = {"rise_k_per_a2": 0.0, "tau_s": 1.0, "growth_um_per_k": 0.5, "ambient_k": -10.0}
        reading = run(actuator(thermal=thermal), np.zeros(100))[0]
        np.testing.assert_allclose(reading, -5.0, atol=0.002)

    def test_coil_warms_by_its_square(self) -> None:
        """A sine and a steady current of its effective value warm alike, by their time constant."""
        thermal = {"rise_k_per_a2": 0.5, "tau_s": 0.5, "growth_um_per_k": 1.0}
        time_s = np.arange(2000) / 1000.0
        sine = 4.0 * np.sin(2.0 * np.pi * 50.0 * time_s)
        grown = [
            run(actuator(1000.0, thermal=thermal), command_a)[0]
            - run(actuator(1000.0), command_a)[0]
            for command_a in (sine, np.full(2000, 4.0 / np.sqrt(2.0)))
        ]
        expected = 0.5 * 8.0 * -np.expm1(-time_s / 0.5)
        np.testing.assert_allclose(grown[1], expected, atol=0.02)
        np.testing.assert_allclose(grown[0], expected, atol=0.05)

    def test_bias_warms_too(self) -> None:
        """A coil that carries the bias warms at rest."""
        thermal = {"rise_k_per_a2": 0.5, "tau_s": 0.1, "growth_um_per_k": 1.0}
        reading = run(actuator(1000.0, thermal=thermal, bias_a=-2.0), np.zeros(1000))[0]
        assert reading[-1] == pytest.approx(2.0, abs=0.01)


class TestSecondMode:
    """Structure with two modes."""

    def test_static_displacement_stays(self) -> None:
        """The second mode's share is taken from the first."""
        mode = {"frequency_hz": 900.0, "damping_ratio": 0.05, "share": 0.1}
        held = [
            run(actuator(**given), np.full(5000, 3.0))[0][-1]
            for given in ({}, {"second_mode": mode})
        ]
        assert held[1] == pytest.approx(held[0], abs=0.004)

    def test_rings_at_its_own_frequency(self) -> None:
        """What a step leaves of two modes less the first alone is the second's decay."""
        mode = {"frequency_hz": 700.0, "damping_ratio": 0.02, "share": 0.3}
        rods = replace(PinnedCellsParameters(), lag_s=1e-6)
        brisk = replace(
            options(second_mode=mode).parameters(), rods=rods, dac_codes=2**30, damping_ratio=0.9
        )
        ringing = run(TerfenolActuator(brisk, 200e3), np.full(40_000, 0.2))[0]
        ringing = ringing[400:] - ringing[-1]
        crossings = np.flatnonzero(np.diff(np.sign(ringing)))[:9]
        half_period_s = np.diff(crossings).mean() / 200e3
        assert 0.5 / half_period_s == pytest.approx(700.0, rel=0.01)
        peaks = [np.abs(ringing[a:b]).max() for a, b in pairwise(crossings)]
        decay = np.mean(np.diff(np.log(peaks))) / np.pi
        assert -decay == pytest.approx(0.02, rel=0.05)


class TestVoltageLimit:
    """An amplifier with so much voltage."""

    LIMIT: ClassVar = {"voltage_max_v": 60.0, "resistance_ohm": 4.0, "inductance_h": 5e-3}

    def test_step_rises_as_the_voltage_drives_it(self) -> None:
        """A large step follows V / R (1 - exp(-R t / L)) until it is nearly there, then settles."""
        current_a = run(actuator(amplifier=self.LIMIT), np.full(200, 9.0))[1]
        time_s = np.arange(200) / RATE_HZ
        driven = 15.0 * -np.expm1(-time_s * 4.0 / 5e-3)
        rising = driven < 8.0
        np.testing.assert_allclose(current_a[rising], driven[rising], atol=4e-4)
        assert current_a.max() <= 9.0002
        assert current_a[-1] == pytest.approx(9.0, abs=4e-4)

    def test_falls_faster_than_it_rises(self) -> None:
        """On the way back resistance helps the voltage."""
        command_a = np.repeat([9.0, 0.0], 200)
        current_a = run(actuator(amplifier=self.LIMIT), command_a)[1]
        assert 9.0 - current_a[210] > 1.5 * current_a[10]

    def test_small_signals_do_not_notice(self) -> None:
        """Where the voltage suffices the current is the unlimited one, bit for bit."""
        command_a = 0.5 * np.sin(np.arange(2000) / 40.0)
        for one, other in zip(
            run(actuator(amplifier=self.LIMIT), command_a), run(actuator(), command_a), strict=True
        ):
            np.testing.assert_array_equal(one, other)

    def test_weak_amplifier_never_gets_there(self) -> None:
        """A current that the voltage can't hold is not reached."""
        weak = self.LIMIT | {"voltage_max_v": 12.0}
        current_a = run(actuator(amplifier=weak), np.full(2000, -9.0))[1]
        assert current_a[-1] == pytest.approx(-3.0, abs=4e-4)

    @pytest.mark.parametrize("rate_hz", [5e3, 50e3, 200e3])
    def test_rate_does_not_matter(self, rate_hz: float) -> None:
        """The same moment after a step, the same current, at any sample rate."""
        n = round(1e-3 * rate_hz)
        current_a = run(actuator(rate_hz, amplifier=self.LIMIT), np.full(n + 1, 9.0))[1]
        assert current_a[-1] == pytest.approx(15.0 * -np.expm1(-0.8), abs=4e-4)


def test_without_options_nothing_is_there() -> None:
    """The rated rig has none of them."""
    rated = TerfenolParameters()
    assert (rated.creep, rated.thermal, rated.second_mode, rated.amplifier) == (None,) * 4
