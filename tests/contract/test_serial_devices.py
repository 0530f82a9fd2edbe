"""The same contract for ``serial_dac``: every shipped profile of a serial line, emulated on a pty.

The checks are those of ``test_devices.py``, run with the benches of this file. Where a device has
no input, the sensor stands on another one.
"""

import importlib.util
import time
from contextlib import ExitStack
from pathlib import Path

import numpy as np
import pytest

from hilctl.errors import DeviceError
from hilctl.registry import device_class
from hilctl_drivers.emulator.serial_server import SerialEmulation, emulated_serial
from hilctl_drivers.profile import load_profile, shipped_profiles

READER = "agilent_34970a"
STREAM_RATE_HZ = 10_000.0
BLOCK = 10
MUST_BE_AT_REST = {"kepco_bop", "tdk_lambda_gen"}


def _checks():
    path = Path(__file__).with_name("test_devices.py")
    spec = importlib.util.spec_from_file_location("device_contract_checks", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


CHECKS = _checks()
globals().update(
    {
        name: check
        for name, check in vars(CHECKS).items()
        if name.startswith("test_") and name != "test_every_device_is_tried"
    }
)


def serial_profiles():
    """Return the shipped profiles of serial devices, by name."""
    kinds = {name: load_profile(name).link.kind for name in shipped_profiles()}
    return [name for name, kind in kinds.items() if kind in {"ascii", "frames"}]


class Clock:
    """The emulator's time: for streams the machine's, else it passes one sample an exchange."""

    def __init__(self, *, real):
        self.now_ns = 1_000_000_000
        self._real = real

    def __call__(self):
        return time.monotonic_ns() if self._real else self.now_ns


class SerialBench:
    """A serial_dac and how to use it, as the checks expect it.

    Behind a FIFO it holds the last command until the answers of what was sent have come.
    """

    def __init__(self, device, rate_hz, clock):
        self.device = device
        self.rate_hz = rate_hz
        self.block = BLOCK if device.info.latency_blocks else 1
        self._clock = clock
        self._sent = 0

    def open(self):
        self.device.open(self.rate_hz, self.block)
        self._sent = 0

    def exchange(self, first, command):
        """Exchange any number of samples, a block at a time."""
        del first  # on one line samples follow one another
        latency = self.device.info.latency_blocks
        command = np.asarray(command, dtype=np.float64)
        size = -(-command.size // self.block) * self.block
        padded = np.concatenate([command, np.full(size - command.size, command[-1])])
        held = np.full(latency * self.block, command[-1])
        displacement_um = np.full(padded.size + held.size, np.nan)
        measured = np.full(padded.size + held.size, np.nan)
        for start in range(0, padded.size + held.size, self.block):
            part = slice(start, start + self.block)
            self._clock.now_ns += round(1e9 / self.rate_hz)
            sent = np.concatenate([padded, held])[part]
            before = sent.copy()
            self.device.exchange(self._sent, sent, displacement_um[part], measured[part])
            assert np.array_equal(sent, before)
            self._sent += self.block
        answers = displacement_um[held.size :]
        return answers[: command.size], measured[: command.size]

    @property
    def middle(self):
        """A command well inside the range that is not the resting one."""
        info = self.device.info
        return 0.5 * (info.command_max + max(0.0, info.command_min))


def wired(name, tmp_path, stack):
    """Return a serial_dac that is wired to an emulator of the profile."""
    profile = load_profile(name)
    path = tmp_path / f"{name}.yaml"
    text = shipped_profiles()[name].read_text()
    path.write_text(text.replace("boot_wait_s: 2.0", "boot_wait_s: 0.0"))
    stream = getattr(profile, "exchange", "none") == "stream"
    clock = Clock(real=stream)
    measures = [getattr(each, "measures", "terminal") for each in profile.inputs.values()]
    reader = None if "terminal" in measures else READER
    wanted = SerialEmulation(str(path), reader=reader, own_line=True)
    emulator = stack.enter_context(emulated_serial(wanted, clock))
    options = {**emulator.options, "timeout_s": 5.0, "fifo_blocks": 4}
    chosen = device_class("serial_dac")
    device = chosen(chosen.Options.model_validate(options))
    stack.callback(device.close)
    rate_hz = STREAM_RATE_HZ if stream else device.info.max_rate_hz
    return SerialBench(device, rate_hz, clock)


@pytest.fixture
def make(tmp_path):
    """Return a function that makes a device of a profile; all are closed afterwards."""
    with ExitStack() as stack:
        yield lambda name: wired(name, tmp_path, stack)


@pytest.fixture(params=serial_profiles())
def case(request):
    """A shipped profile of a serial device."""
    return request.param


@pytest.fixture
def bench(make, case):
    """A device that was not opened yet."""
    return make(case)


def test_opening_does_not_move_the_output(bench, case):
    """Supplies that must be set up at 0 A are refused while current flows; others stay put."""
    if case not in MUST_BE_AT_REST:
        CHECKS.test_opening_does_not_move_the_output(bench)
        return
    bench.open()
    bench.exchange(0, np.full(5, bench.middle))
    bench.device.close()
    with pytest.raises(DeviceError, match="no current may flow when it is taken over"):
        bench.open()


def test_every_kind_of_line_is_tried():
    """Lines of text, single frames and streams are all among the shipped profiles."""
    assert {
        "kepco_bop",
        "icp_m7024_dcon",
        "tdk_lambda_gen",
        "cobs_board",
        "cobs_board_fifo",
    } <= set(serial_profiles())
