"""The device contract of ``serial_dac`` for every shipped serial profile, emulated on a pty.

The checks are those of ``test_devices.py``. If a device has no input, a second device reads the
sensor, on its own or on the same line.
"""

import time
from contextlib import ExitStack
from pathlib import Path

import numpy as np
import pytest

from hilctl.base.errors import DeviceError
from hilctl.experiment.devices import device_class
from hilctl_drivers import contract
from hilctl_drivers.contract import *  # noqa: F403  the checks, and the fixture driven
from hilctl_drivers.emulator.options import EmulatorOptions
from hilctl_drivers.profile import load_profile, shipped_profiles
from tests.fakes import emulated

SERIAL = (
    "adam_4024_ascii agilent_34970a own", "adam_4024_ascii only_reads same", "agilent_34970a",
    "cobs_board", "cobs_board_fifo", "icp_m7024_dcon agilent_34970a own",
    "kepco_bop agilent_34970a own", "tdk_lambda_gen agilent_34970a own",
)  # fmt: skip
"""What serial_dac is tried with: what drives, what reads, and whether they share a line."""
ONLY_READS = """\
vendor: nobody
model: a module on the line of another one, with inputs only
source: [this test]
verified: "yes"
link: {kind: ascii, baud: 9600, terminator: "\\r", reply_terminator: "\\r"}
address: 2
outputs: {}
inputs:
  AI0:
    {ask: "#{address:02X}0", pattern: ">([-+][0-9]{2}\\\\.[0-9]{4})", example: ">+01.2345", unit: V,
      min: -10.0, max: 10.0}
exchange: none
turnaround_s: 0.001
max_rate_hz: 100.0
watchdog: none
"""
SETTLED_NS = 2_000_000
STREAM_RATE_HZ = 640.0
BLOCK = 10
FIFO_BLOCKS = 32  # 500 ms, the longest stall of a busy machine
MUST_BE_AT_REST = {"kepco_bop", "tdk_lambda_gen"}


def serial_profiles():
    """Return the shipped profiles of serial devices, by name."""
    kinds = {name: load_profile(name).link.kind for name in shipped_profiles()}
    return [name for name, kind in kinds.items() if kind in {"ascii", "frames"}]


class EmulatorClock:
    """The emulator's time: real time for streams, otherwise advanced by exchanges."""

    def __init__(self, *, real):
        self.now_ns = 1_000_000_000
        self._real = real

    def __call__(self):
        return time.monotonic_ns() if self._real else self.now_ns


class DrivenSerial:
    """A serial_dac and its emulation, for the checks.

    With a FIFO, the last command is held until all answers have arrived. Without answers, time
    advances only after a command has arrived.
    """

    name = "serial_dac"
    starts_at_rest = False
    must_be_at_rest = False
    reads_back = True

    def __init__(self, device, rate_hz, clock, stands, arrived_a=None):
        self.device = device
        self.rate_hz = rate_hz
        self.block = BLOCK if device.info.latency_blocks else 1
        self._clock = clock
        self.stands = stands
        self._arrived_a = arrived_a
        self._sent = 0

    def open(self):
        self.device.open(self.rate_hz, self.block)
        self.device.arm()
        self._sent = 0

    def exchange(self, command):
        """Exchange any number of samples, a block at a time."""
        latency = self.device.info.latency_blocks
        command = np.asarray(command, dtype=np.float64)
        size = -(-command.size // self.block) * self.block
        padded = np.concatenate([command, np.full(size - command.size, command[-1])])
        held = np.full(latency * self.block, command[-1])
        displacement_um = np.full(padded.size + held.size, np.nan)
        measured = np.full(padded.size + held.size, np.nan)
        for start in range(0, padded.size + held.size, self.block):
            part = slice(start, start + self.block)
            self._clock.now_ns += min(round(1e9 / self.rate_hz), SETTLED_NS)
            sent = np.concatenate([padded, held])[part]
            before = sent.copy()
            self.device.exchange(self._sent, sent, displacement_um[part], measured[part])
            assert np.array_equal(sent, before)
            self._await(float(np.clip(sent[-1], -10.0, 10.0)))  # the rig's amplifier
            self._sent += self.block
        answers = displacement_um[held.size :]
        return answers[: command.size], measured[: command.size]

    def assert_stands(self, command):
        """Wait for the output, because some commands are not answered."""
        end_s = time.monotonic() + 5.0
        while abs(self.stands() - command) > contract.STEP:
            assert time.monotonic() < end_s, f"{command} A does not stand"

    def _await(self, sent_a):
        if self._arrived_a is None:
            return
        end_s = time.monotonic() + 5.0
        while abs(self._arrived_a() - sent_a) > 1e-4:
            assert time.monotonic() < end_s, f"{sent_a} A did not arrive"

    @property
    def middle(self):
        """A command well inside the range, different from the resting one."""
        info = self.device.info
        return 0.5 * (info.command_max + max(0.0, info.command_min))


def wired(case, tmp_path, stack):
    """Return a serial_dac connected to an emulator of one or two profiles."""
    name, reader, line = [*case.split(), None, None][:3]
    profile = load_profile(name)
    path = tmp_path / f"{name}.yaml"
    text = shipped_profiles()[name].read_text()
    path.write_text(text.replace("boot_wait_s: 2.0", "boot_wait_s: 0.0"))
    if reader == "only_reads":
        reader = str(tmp_path / "only_reads.yaml")
        Path(reader).write_text(ONLY_READS)
    stream = getattr(profile, "exchange", "none") == "stream"
    clock = EmulatorClock(real=stream)
    wanted = EmulatorOptions(str(path), reader=reader, reader_line=line)
    emulator = stack.enter_context(emulated(wanted, clock))
    options = {**emulator.options, "timeout_s": 5.0, "fifo_blocks": FIFO_BLOCKS}
    chosen = device_class("serial_dac")
    device = chosen(chosen.Options.model_validate(options))
    stack.callback(device.close)
    rate_hz = STREAM_RATE_HZ if stream else device.info.max_rate_hz
    silent = getattr(profile.outputs[options["output"]], "reply", "") == "none"
    apart = silent and line == "own"
    rig = emulator.device._rig

    def stands():
        return rig.current_a

    made = DrivenSerial(device, rate_hz, clock, stands, stands if apart else None)
    made.must_be_at_rest = name in MUST_BE_AT_REST
    made.reads_back = name != "adam_4024_ascii"  # returns its last command, not its output
    return made


@pytest.fixture
def make(tmp_path):
    """Return a factory of devices, which are closed afterwards."""
    with ExitStack() as stack:
        yield lambda name: wired(name, tmp_path, stack)


STREAMS = "cobs_board_fifo"


@pytest.fixture(
    params=[
        # The FIFO drains in real time.
        pytest.param(case, marks=pytest.mark.slow) if case == STREAMS else case
        for case in SERIAL
    ]
)
def case(request):
    """A shipped serial profile, with a reader if it needs one."""
    return request.param


@pytest.fixture
def driven(make, case):
    """A closed device."""
    return make(case)


def test_opening_does_not_move_the_output(driven, case):
    """Opening is rejected for supplies that need set-up at 0 A while current flows."""
    if case.split()[0] not in MUST_BE_AT_REST:
        contract.test_opening_does_not_move_the_output(driven)
        return
    driven.open()
    driven.exchange(np.full(5, driven.middle))
    driven.device.close()
    with pytest.raises(DeviceError, match="no current"):
        driven.open()


def test_no_serial_profile_is_left_out():
    """Each shipped serial profile is tested with its emulation."""
    drives = {case.split()[0] for case in SERIAL}
    reads = {word for case in SERIAL for word in case.split()[1:2]}
    assert drives | (reads - {"only_reads"}) == set(serial_profiles())
    assert {"ascii", "frames"} == {load_profile(name).link.kind for name in drives}
