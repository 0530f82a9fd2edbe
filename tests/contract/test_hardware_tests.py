"""The tests in tests/hardware, run on an emulated device, move it as documented."""

import itertools
import os
import subprocess
import sys
from pathlib import Path

import pytest

from hilctl_drivers.emulator.options import EmulatorOptions, parse_fault
from hilctl_drivers.signal_chain import Amplifier, Sensor
from tests.fakes import emulated, logged, one_rig

ROOT = Path(__file__).parents[2]
GIVE_UP_S = 120.0
PEAK_A = 6.0
POWER_UP_A = -10.0
TENTH_A = 0.1 * PEAK_A
RAMP_S = 0.25
RATE_HZ = 200.0
EXPERIMENT = """\
name: gentle
device:
  kind: modbus_dac
  profile: labjack_t7
  host: 127.0.0.1
  tcp_port: {port}
  output: DAC0
  input: AIN0
  timeout_s: 2.0
  amplifier: {{gain_a_per_v: 4.0, offset_a: -10.0}}
  sensor: {{um_per_v: 12.5}}
  watchdog: none
sample_rate_hz: 200
waveform: {{kind: sine, unit: A, amplitude: 1.0, frequency_hz: 1.0, duration_s: 1.0}}
compensator: none
limits: {{peak_current_a: 6.0, slew_a_per_s: 400.0, stroke_um: [-75.0, 60.0]}}
safe: {{value: 0.0, ramp_s: 0.25}}
"""


def ran(*options):
    """Run the hardware tests in a separate process."""
    command = [sys.executable, "-m", "pytest", "-p", "no:cacheprovider", "tests/hardware"]
    return subprocess.run(
        [*command, *options],
        cwd=ROOT,
        env={**os.environ, "PYTHONDONTWRITEBYTECODE": "1"},
        capture_output=True,
        text=True,
        timeout=GIVE_UP_S,
    )


@pytest.fixture
def suite(tmp_path):
    """Return a function that runs hardware tests on an emulated device.

    It returns the result, and every output current.
    """

    def run(only="test", **options):
        log, path = tmp_path / "writes.jsonl", tmp_path / "experiment.yaml"
        with emulated(EmulatorOptions("labjack_t7", log=log, **options)) as emulator:
            port = emulator.address.rpartition(":")[2]
            path.write_text(EXPERIMENT.format(port=port), encoding="utf-8")
            done = ran("-q", "-k", only, "--device", str(path))
        return done, [each["current_a"] for each in logged(log)]

    return run


@pytest.mark.slow
def test_keeps_to_a_tenth_of_the_limits(suite):
    """All tests pass with at most 10 % of the peak current; ramps are slow except for one step."""
    done, currents_a = suite()
    assert done.returncode == 0, done.stdout
    assert "9 passed" in done.stdout
    assert currents_a[0] == pytest.approx(POWER_UP_A)
    # The device powers up far from the safe value and ramps from there.
    arrived = next(index for index, each in enumerate(currents_a) if each >= 0.0)
    assert currents_a[: arrived + 1] == sorted(currents_a[: arrived + 1])
    assert max(currents_a) == pytest.approx(TENTH_A, rel=1e-3)
    assert min(currents_a[arrived:]) == 0.0
    assert currents_a[-1] == 0.0
    steps_a = sorted(abs(b - a) for a, b in itertools.pairwise(currents_a))
    assert steps_a[-1] == pytest.approx(TENTH_A, rel=1e-3)  # the step of make_safe
    assert steps_a[-2] <= PEAK_A / RAMP_S / RATE_HZ * 1.001


@pytest.mark.slow
def test_failure_ends_at_the_safe_value(suite):
    done, currents_a = suite(only="small_move", faults=(parse_fault("exception@250"),))
    assert done.returncode == 1
    assert "exception 4" in done.stdout
    assert 0.0 < max(currents_a) <= TENTH_A * 1.001
    assert currents_a[-1] == 0.0


@pytest.mark.slow
def test_amplifier_that_is_off_is_found(suite):
    off = Amplifier(gain_a_per_v=1e-9, offset_a=-2.5e-9), Sensor(um_per_v=12.5)
    done, currents_a = suite(only="small_move", rigs=one_rig(wiring=off))
    assert done.returncode == 1
    assert "nothing moved" in done.stdout
    assert currents_a[-1] == 0.0


@pytest.mark.slow
def test_without_a_device_nothing_is_run():
    done = ran()
    assert done.returncode == pytest.ExitCode.NO_TESTS_COLLECTED
    assert done.stdout.count("--device EXPERIMENT.yaml") == 1
    assert "9 deselected" in done.stdout
    assert "skipped" not in done.stdout
