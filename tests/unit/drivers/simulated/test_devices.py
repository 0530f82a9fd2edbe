"""The simulated rigs as devices."""

import numpy as np
import pytest
from pydantic import ValidationError

from hilctl.base.errors import DeviceError, InputError
from hilctl_drivers.simulated.devices import (
    PiezoOptions,
    SimulatedPiezo,
    SimulatedTerfenol,
    TerfenolOptions,
)
from hilctl_drivers.simulated.simulated_device import SimulatedFault
from tests.unit.base.test_calibration import AMPLIFIER, CALIBRATION

RATE_HZ = 50e3
BLOCK = 50


def opened(device, block=BLOCK):
    device.open(RATE_HZ, block)
    return device


def terfenol(**options):
    return opened(SimulatedTerfenol(TerfenolOptions.model_validate(options)))


def send(device, first_sample, command):
    displacement_um = np.full(command.size, -999.0)
    device.exchange(first_sample, command, displacement_um, np.empty(command.size))
    return displacement_um


def send_all(device, command, first_sample=0):
    starts = range(0, command.size, BLOCK)
    parts = [send(device, first_sample + k, command[k : k + BLOCK]) for k in starts]
    return np.concatenate(parts)


def wave(n):
    return 3.0 * np.sin(2.0 * np.pi * 200.0 * np.arange(n) / RATE_HZ)


TEMPERATURES = {"ambient_c": 20.0, "resistance_ohm": 2.0, "coil_tau_s": 1e-3, "rod_tau_s": 1e-3}


class TestTemperatures:
    def test_end_at_the_loss_of_the_coil_and_move_nothing(self):
        warm, cold = terfenol(temperatures=TEMPERATURES), terfenol()
        command = np.full(1000, 3.0)
        assert warm.aux.tolist() == [20.0, 20.0]
        np.testing.assert_array_equal(send_all(warm, command), send_all(cold, command))
        send(warm, 2000, command[:BLOCK])  # skipped samples warm the coil too
        np.testing.assert_allclose(warm.aux, [20.0 + 2.0 * 9.0, 20.0 + 9.0], atol=0.01)
        assert [each.name for each in warm.info.aux] == ["coil_c", "rod_c"]
        assert cold.info.aux == ()

    def test_fault(self):
        device = terfenol(temperatures=TEMPERATURES, fault={"kind": "aux_nan", "at_sample": BLOCK})
        send(device, 0, wave(BLOCK))
        assert np.isfinite(device.aux).all()
        send(device, BLOCK, wave(BLOCK))
        assert np.isnan(device.aux).all()


class TestVariedRig:
    @pytest.mark.parametrize(("name", "attribute", "power"), [
        ("lag", "lag_s", 1),
        ("pinning", "pinning_max_a_per_m", 1),
        ("strain", "strain_um", 1),
        ("resonance", "stiffness_n_per_m", 2),
        ("damping", "damping_ratio", 1),
    ])  # fmt: skip
    def test_factor(self, name, attribute, power):
        """Each factor changes one constant, which is kept with a recording, and the motion."""
        varied = terfenol(noise=False, vary={name: 1.1})
        rated = terfenol(noise=False)
        ratio = float(varied.info.details[attribute]) / float(rated.info.details[attribute])
        assert ratio == pytest.approx(1.1**power)
        difference = send_all(varied, wave(1000)) - send_all(rated, wave(1000))
        assert np.abs(difference).max() > 0.03

    def test_without_magnets_displacement_is_even(self):
        """Either way of the current makes the rods longer, by the same."""
        up, down = terfenol(noise=False, magnet=False), terfenol(noise=False, magnet=False)
        one, other = send_all(up, wave(1000)), send_all(down, -wave(1000))
        np.testing.assert_allclose(one, other, atol=1e-9)
        assert one.max() > 5.0
        assert one.min() > -0.2

    def test_bias_leaves_less_to_the_command(self):
        """The limit holds for bias and command together; the DAC's range for the command."""
        info = SimulatedTerfenol(TerfenolOptions(bias_a=2.0, current_max_a=5.0)).info
        assert (info.command_min, info.command_max) == (-7.0, 3.0)
        info = SimulatedTerfenol(TerfenolOptions(bias_a=-2.0)).info
        assert (info.command_min, info.command_max) == (-8.0, 10.0)
        with pytest.raises(ValidationError, match="leave room"):
            TerfenolOptions(bias_a=5.0, current_max_a=5.0)

    def test_drift(self):
        """It grows to its end by its time constant, and starts over when opened again."""
        device = terfenol(noise=False, drift={"um": 4.0, "tau_s": 0.01})
        for _ in range(2):
            opened(device)
            grown = send_all(device, np.zeros(5000))
            expected = 4.0 * -np.expm1(-np.arange(5000) / (0.01 * RATE_HZ))
            np.testing.assert_allclose(grown, expected, atol=0.003)


@pytest.fixture(params=["terfenol", "piezo"])
def closed(request):
    if request.param == "terfenol":
        return SimulatedTerfenol(TerfenolOptions())
    return SimulatedPiezo(PiezoOptions())


def test_open_starts_at_rest(closed):
    """A device that is opened again gives the same readings again."""
    command = np.abs(wave(1000))
    first = send_all(opened(closed), command)
    closed.close()
    np.testing.assert_array_equal(send_all(opened(closed), command), first)


@pytest.mark.parametrize("block", [0, 4097])
def test_open_refuses_block(closed, block):
    with pytest.raises(DeviceError, match=r"block.*4096"):
        closed.open(RATE_HZ, block)


@pytest.mark.parametrize("value", [5.01, -5.01, np.nan])
def test_a_refused_block_is_not_noticed_by_the_plant(value):
    """The text names device, index, value and range."""
    device, twin = terfenol(current_max_a=5.0), terfenol(current_max_a=5.0)
    bad = np.full(BLOCK, 2.0)
    bad[7] = value
    pattern = rf"simulated_terfenol: command\[7\].*\[-5, 5\] A, got {value}"
    with pytest.raises(DeviceError, match=pattern):
        send(device, 0, bad)
    np.testing.assert_array_equal(send_all(device, wave(500)), send_all(twin, wave(500)))


@pytest.mark.parametrize("sizes", [(0, 0, 0), (51, 51, 51), (50, 49, 50), (50, 50, 51)])
def test_wrong_sizes(sizes):
    with pytest.raises(DeviceError, match="50 samples"):
        terfenol().exchange(0, *(np.zeros(size) for size in sizes))


class TestSampleCount:
    def test_skipped_samples_hold_the_last_command(self):
        """A jump of the index equals sending the last command over and over."""
        command = wave(2 * BLOCK)
        jumped, sent = terfenol(), terfenol()
        for device in (jumped, sent):
            send(device, 0, command[:BLOCK])
        send_all(sent, np.full(3 * BLOCK, command[BLOCK - 1]), BLOCK)
        np.testing.assert_array_equal(
            send(jumped, 4 * BLOCK, command[BLOCK:]), send(sent, 4 * BLOCK, command[BLOCK:])
        )

    def test_samples_going_back(self):
        """A block whose samples have passed already is refused."""
        device = terfenol()
        send(device, 0, np.zeros(BLOCK))
        with pytest.raises(DeviceError, match=r">= 50.*got 49"):
            send(device, BLOCK - 1, np.zeros(BLOCK))


class TestFaults:
    AT = 130  # inside the third block

    @pytest.mark.parametrize("kind", ["sensor_nan", "sensor_frozen", "sensor_jump"])
    def test_sensor(self, kind):
        """No number; the last good reading, block after block; off by half the sensor's range."""
        fault = SimulatedFault.model_validate({"kind": kind, "at_sample": self.AT})
        faulty, good = send_all(terfenol(fault=fault), wave(300)), send_all(terfenol(), wave(300))
        np.testing.assert_array_equal(faulty[: self.AT], good[: self.AT])
        expected = {
            "sensor_nan": np.full(300, np.nan),
            "sensor_frozen": np.full(300, good[self.AT - 1]),
            "sensor_jump": good + 62.5,
        }
        np.testing.assert_allclose(
            faulty[self.AT :], expected[kind][self.AT :], rtol=0.0, atol=1e-9
        )

    @pytest.mark.parametrize(
        ("kind", "text"), [("no_answer", "in time"), ("refused", "was refused")]
    )
    def test_connection(self, kind, text):
        """The block that holds the sample fails and so do later ones; make_safe still works."""
        device = terfenol(fault={"kind": kind, "at_sample": self.AT})
        send_all(device, wave(100))
        for first_sample, words in ((100, text), (150, "not open")):
            with pytest.raises(DeviceError, match=words):
                send(device, first_sample, np.zeros(BLOCK))
        device.make_safe(1.0)
        assert device.last_command == 1.0


@pytest.fixture
def calibration(tmp_path):
    """A file with readings of -50 to 50 um, whose true displacement is 1 um more."""
    path = tmp_path / "calibration.yaml"
    path.write_text(CALIBRATION)
    return path


def test_a_calibration_corrects_readings(calibration):
    plain, device = terfenol(), terfenol(calibration=str(calibration))
    displacement_um = send_all(device, wave(1000))
    np.testing.assert_allclose(displacement_um, send_all(plain, wave(1000)) + 1.0)
    np.testing.assert_allclose(device.reading_um, displacement_um[-BLOCK:] - 1.0)
    assert device.info.files["calibration.yaml"] == CALIBRATION


def test_a_reading_out_of_the_calibrated_range_is_its_end(calibration):
    """The interlock treats the ends of the sensor's range as invalid."""
    fault = {"kind": "sensor_jump", "at_sample": 0}
    device = terfenol(calibration=str(calibration), fault=fault)
    info = device.info
    assert (info.sensor_min_um, info.sensor_max_um) == (-49.0, 51.0)
    assert (send_all(device, wave(BLOCK)) == 51.0).all()
    assert (device.reading_um > 51.0).all()


def test_a_simulated_device_has_no_amplifier_to_calibrate(calibration):
    calibration.write_text(CALIBRATION + AMPLIFIER)
    with pytest.raises(InputError, match="amplifier"):
        terfenol(calibration=str(calibration))


def test_a_bent_sensor_has_its_largest_error_in_percent_of_the_range():
    bent, plain = terfenol(noise=False, nonlinearity_percent=1.5), terfenol(noise=False)
    command = np.linspace(0.0, 8.0, 5000)
    error = send_all(bent, command) - (straight := send_all(plain, command))
    share = straight / plain.info.sensor_max_um
    np.testing.assert_allclose(error, 3.75 * 1.5 * 3**0.5 * (share - share**3), atol=1e-9)
