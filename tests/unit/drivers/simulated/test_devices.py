"""The simulated rigs as devices."""

import numpy as np
import pytest
from pydantic import ValidationError

from hilctl.base.device import Device
from hilctl.base.types import F64
from hilctl_drivers.simulated.devices import SimulatedTerfenol, TerfenolOptions
from hilctl_drivers.simulated.simulated_device import SimulatedDevice

RATE_HZ = 50e3
BLOCK = 50


def opened(device: SimulatedDevice, block: int = BLOCK) -> SimulatedDevice:
    device.open(RATE_HZ, block)
    return device


def terfenol(**options: object) -> SimulatedDevice:
    return opened(SimulatedTerfenol(TerfenolOptions.model_validate(options)))


def send(device: Device, first_sample: int, command: F64) -> F64:
    displacement_um = np.full(command.size, -999.0)
    device.exchange(first_sample, command, displacement_um, np.empty(command.size))
    return displacement_um


def send_all(device: Device, command: F64, first_sample: int = 0) -> F64:
    starts = range(0, command.size, BLOCK)
    parts = [send(device, first_sample + k, command[k : k + BLOCK]) for k in starts]
    return np.concatenate(parts)


def wave(n: int) -> F64:
    command: F64 = 3.0 * np.sin(2.0 * np.pi * 200.0 * np.arange(n) / RATE_HZ)
    return command


class TestVariedRig:
    """Actuators that differ from the rated one."""

    @pytest.mark.parametrize(
        ("name", "attribute", "power"),
        [
            ("lag", "lag_s", 1),
            ("pinning", "pinning_max_a_per_m", 1),
            ("strain", "strain_um", 1),
            ("resonance", "stiffness_n_per_m", 2),
            ("damping", "damping_ratio", 1),
        ],
    )
    def test_factor(self, name: str, attribute: str, power: int) -> None:
        """Each factor changes one constant, which is kept with a recording, and the motion."""
        varied = terfenol(noise=False, vary={name: 1.1})
        rated = terfenol(noise=False)
        ratio = float(varied.info.details[attribute]) / float(rated.info.details[attribute])
        assert ratio == pytest.approx(1.1**power)
        difference = send_all(varied, wave(1000)) - send_all(rated, wave(1000))
        assert np.abs(difference).max() > 0.03

    def test_absurd_factor(self) -> None:
        """A factor that makes another device of it is refused."""
        with pytest.raises(ValidationError, match="vary"):
            TerfenolOptions.model_validate({"vary": {"lag": 3.0}})

    def test_without_magnets_displacement_is_even(self) -> None:
        """Either way of the current makes the rods longer, by the same."""
        up, down = terfenol(noise=False, magnet=False), terfenol(noise=False, magnet=False)
        one, other = send_all(up, wave(1000)), send_all(down, -wave(1000))
        np.testing.assert_allclose(one, other, atol=1e-9)
        assert one.max() > 5.0
        assert one.min() > -0.2

    def test_bias_leaves_less_to_the_command(self) -> None:
        """The limit holds for bias and command together; the DAC's range for the command."""
        info = SimulatedTerfenol(TerfenolOptions(bias_a=2.0, current_max_a=5.0)).info
        assert (info.command_min, info.command_max) == (-7.0, 3.0)
        info = SimulatedTerfenol(TerfenolOptions(bias_a=-2.0)).info
        assert (info.command_min, info.command_max) == (-8.0, 10.0)
        with pytest.raises(ValidationError, match="leave room"):
            TerfenolOptions(bias_a=5.0, current_max_a=5.0)

    def test_drift(self) -> None:
        """It grows to its end by its time constant, and starts over when opened again."""
        device = terfenol(noise=False, drift={"um": 4.0, "tau_s": 0.01})
        for _ in range(2):
            opened(device)
            grown = send_all(device, np.zeros(5000))
            expected = 4.0 * -np.expm1(-np.arange(5000) / (0.01 * RATE_HZ))
            np.testing.assert_allclose(grown, expected, atol=0.003)
