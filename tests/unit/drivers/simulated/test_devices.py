"""The simulated rigs as devices."""

import numpy as np
import pytest
from pydantic import ValidationError

from hilctl.base.device import Device
from hilctl.base.errors import DeviceError
from hilctl.base.types import F64
from hilctl_drivers.simulated.devices import (
    PiezoOptions,
    SimulatedDevice,
    SimulatedFault,
    SimulatedPiezo,
    SimulatedTerfenol,
    TerfenolOptions,
)

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


@pytest.fixture(params=["terfenol", "piezo"])
def closed(request: pytest.FixtureRequest) -> SimulatedDevice:
    if request.param == "terfenol":
        return SimulatedTerfenol(TerfenolOptions())
    return SimulatedPiezo(PiezoOptions())


class TestLife:
    """Open, exchange, close."""

    def test_exchange_needs_open(self, closed: SimulatedDevice) -> None:
        """Neither before open nor after close does an exchange work."""
        with pytest.raises(DeviceError, match=closed.info.name + ".*open"):
            send(closed, 0, np.zeros(BLOCK))
        opened(closed).close()
        with pytest.raises(DeviceError, match="open"):
            send(closed, 0, np.zeros(BLOCK))

    def test_close_twice(self, closed: SimulatedDevice) -> None:
        """Closing twice is fine, and so is closing what was never open."""
        closed.close()
        opened(closed).close()
        closed.close()

    def test_open_starts_at_rest(self, closed: SimulatedDevice) -> None:
        """A device that is opened again gives the same readings again."""
        command = np.abs(wave(1000))
        first = send_all(opened(closed), command)
        closed.close()
        np.testing.assert_array_equal(send_all(opened(closed), command), first)

    @pytest.mark.parametrize("rate_hz", [0.0, -1.0, 200_001.0, np.nan, np.inf])
    def test_open_refuses_rate(self, closed: SimulatedDevice, rate_hz: float) -> None:
        """A rate that it can't keep is refused, with the range in the text."""
        with pytest.raises(DeviceError, match=r"sample rate.*200000"):
            closed.open(rate_hz, BLOCK)

    @pytest.mark.parametrize("block", [0, 4097])
    def test_open_refuses_block(self, closed: SimulatedDevice, block: int) -> None:
        """A block that does not fit the FIFO is refused."""
        with pytest.raises(DeviceError, match=r"block.*4096"):
            closed.open(RATE_HZ, block)

    def test_info(self, closed: SimulatedDevice) -> None:
        """It says that it is buffered, and its details hold parameters and options as text."""
        info = closed.info
        assert info.buffered
        assert info.fifo_depth == 4096
        assert info.measures_command
        assert info.details["seed"] == "1"
        assert float(info.details["sensor_bandwidth_hz"]) > 0.0

    def test_details_of_the_actuator(self) -> None:
        """Load and bias are kept with the recording."""
        info = SimulatedTerfenol(TerfenolOptions(load_kg=3.7, bias_a=0.2)).info
        assert (info.details["load_kg"], info.details["bias_a"]) == ("3.7", "0.2")
        assert info.details["stiffness_n_per_m"] == "33597000.0"

    def test_noise_can_be_turned_off(self) -> None:
        """Without noise, a device at rest reads exactly 0."""
        assert not send(terfenol(noise=False), 0, np.zeros(BLOCK)).any()
        piezo = opened(SimulatedPiezo(PiezoOptions(noise=False)))
        assert not send(piezo, 0, np.zeros(BLOCK)).any()


class TestRefusals:
    """What an exchange turns down; nothing is sent then."""

    @pytest.mark.parametrize("value", [5.01, -5.01, np.nan, np.inf, -np.inf])
    def test_command_out_of_range(self, value: float) -> None:
        """The text names device, index, value and range, and the plant has not noticed."""
        device, twin = terfenol(current_max_a=5.0), terfenol(current_max_a=5.0)
        bad = np.full(BLOCK, 2.0)
        bad[7] = value
        pattern = rf"simulated_terfenol: command\[7\].*\[-5, 5\] A, got {value}"
        with pytest.raises(DeviceError, match=pattern):
            send(device, 0, bad)
        np.testing.assert_array_equal(send_all(device, wave(500)), send_all(twin, wave(500)))

    @pytest.mark.parametrize("value", [-0.1, 100.1, np.nan])
    def test_drive_out_of_range(self, value: float) -> None:
        """The piezo takes 0..100 V."""
        piezo = opened(SimulatedPiezo(PiezoOptions()))
        with pytest.raises(DeviceError, match=r"command\[0\].*\[0, 100\] V"):
            send(piezo, 0, np.full(BLOCK, value))

    def test_ends_of_the_range(self, closed: SimulatedDevice) -> None:
        """Both ends of the range are accepted."""
        info = opened(closed).info
        send(closed, 0, np.array([info.command_min, info.command_max]))

    def test_samples_going_back(self) -> None:
        """A block whose samples have passed already is refused."""
        device = terfenol()
        send(device, 0, np.zeros(BLOCK))
        with pytest.raises(DeviceError, match=r">= 50.*got 49"):
            send(device, BLOCK - 1, np.zeros(BLOCK))

    @pytest.mark.parametrize("sizes", [(0, 0, 0), (51, 51, 51), (50, 49, 50), (50, 50, 51)])
    def test_wrong_sizes(self, sizes: tuple[int, int, int]) -> None:
        """Blocks that are empty, too long or of unequal length are refused."""
        with pytest.raises(DeviceError, match="50 samples"):
            terfenol().exchange(0, *(np.zeros(size) for size in sizes))


class TestSampleCount:
    """The sample index is the time."""

    def test_skipped_samples_hold_the_last_command(self) -> None:
        """A jump of the index equals sending the last command over and over."""
        command = wave(2 * BLOCK)
        jumped, sent = terfenol(), terfenol()
        for device in (jumped, sent):
            send(device, 0, command[:BLOCK])
        send_all(sent, np.full(3 * BLOCK, command[BLOCK - 1]), BLOCK)
        np.testing.assert_array_equal(
            send(jumped, 4 * BLOCK, command[BLOCK:]), send(sent, 4 * BLOCK, command[BLOCK:])
        )

    def test_block_does_not_matter(self) -> None:
        """Readings are the same for blocks of 50 and for one block of 500."""
        blocks, whole = terfenol(), opened(SimulatedTerfenol(TerfenolOptions()), 500)
        np.testing.assert_array_equal(send_all(blocks, wave(500)), send(whole, 0, wave(500)))

    def test_measured_follows_the_command(self, closed: SimulatedDevice) -> None:
        """The measured command settles at the command, within one DAC code."""
        measured = np.empty(BLOCK)
        opened(closed).exchange(0, np.full(BLOCK, 2.0), np.empty(BLOCK), measured)
        assert measured[0] == 0.0
        assert measured[-1] == pytest.approx(2.0, abs=2e-3)


class TestMakeSafe:
    """The last resort."""

    def test_works_open_or_closed(self, closed: SimulatedDevice) -> None:
        """It sets the output without a connection, with one, and after one."""
        closed.make_safe(1.0)
        assert closed._last_command == 1.0
        send(opened(closed), 0, np.full(BLOCK, 3.0))
        closed.make_safe(0.5)
        assert closed._last_command == 0.5
        closed.close()
        closed.make_safe(0.0)
        assert closed._last_command == 0.0

    def test_holds_until_it_is_opened_again(self) -> None:
        """It lets go of the device: nothing that is sent afterwards can move the output."""
        device = terfenol()
        send(device, 0, np.full(BLOCK, 3.0))
        device.make_safe(1.0)
        with pytest.raises(DeviceError, match="not open"):
            send(device, BLOCK, np.zeros(BLOCK))
        assert device._last_command == 1.0
        send(opened(device), 0, np.zeros(BLOCK))

    @pytest.mark.parametrize("value", [11.0, np.nan])
    def test_refuses_out_of_range(self, value: float) -> None:
        """A value out of range is refused there too, and the output stays."""
        device = terfenol()
        with pytest.raises(DeviceError, match="simulated_terfenol"):
            device.make_safe(value)
        assert device._last_command == 0.0


class TestFaults:
    """Injected faults: from their sample on, and not before."""

    AT = 130  # inside the third block

    def both(self, kind: str) -> tuple[F64, F64]:
        faulty = terfenol(fault=SimulatedFault.model_validate({"kind": kind, "at_sample": self.AT}))
        readings = send_all(faulty, wave(300)), send_all(terfenol(), wave(300))
        np.testing.assert_array_equal(readings[0][: self.AT], readings[1][: self.AT])
        return readings[0][self.AT :], readings[1][self.AT :]

    def test_sensor_nan(self) -> None:
        """Readings are not numbers."""
        faulty, _ = self.both("sensor_nan")
        assert np.isnan(faulty).all()

    def test_sensor_frozen(self) -> None:
        """The last good reading is repeated, block after block."""
        faulty, _ = self.both("sensor_frozen")
        before = send_all(terfenol(), wave(300))[self.AT - 1]
        assert (faulty == before).all()

    def test_sensor_jump(self) -> None:
        """Readings are off by half the sensor's range."""
        faulty, good = self.both("sensor_jump")
        np.testing.assert_allclose(faulty - good, 62.5, rtol=0.0, atol=1e-9)

    @pytest.mark.parametrize(
        ("kind", "text"), [("no_answer", "in time"), ("refused", "was refused")]
    )
    def test_connection(self, kind: str, text: str) -> None:
        """The block that holds the sample fails and so do later ones; make_safe still works."""
        device = terfenol(fault={"kind": kind, "at_sample": self.AT})
        send_all(device, wave(100))
        for first_sample, words in ((100, text), (150, "not open")):
            with pytest.raises(DeviceError, match=words):
                send(device, first_sample, np.zeros(BLOCK))
        device.make_safe(0.0)

    def test_unknown_kind(self) -> None:
        """A fault that does not exist is refused with the options."""
        with pytest.raises(ValidationError, match="sensor_frozen"):
            TerfenolOptions.model_validate({"fault": {"kind": "fire", "at_sample": 0}})
