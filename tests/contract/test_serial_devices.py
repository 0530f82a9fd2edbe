"""The device contract of ``serial_dac`` for every shipped profile of it, emulated.

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
from hilctl_drivers.simulated.devices import PiezoOptions, TerfenolOptions
from tests.fakes import ManualClock, emulated, one_rig

SERIAL = (
    "adam_4024_ascii agilent_34970a own", "adam_4024_ascii only_reads same", "agilent_34970a",
    "cobs_board", "cobs_board_fifo", "icp_m7024_dcon agilent_34970a own",
    "kepco_bop agilent_34970a own", "tdk_lambda_gen agilent_34970a own",
    "kepco_bop labjack_t7 own", "icp_m7024_dcon adam_4117 own", "cobs_board labjack_t7 own",
    "kepco_bop cobs_board own", "magna_power_sl keyence_cl3000 own",
    "kepco_bop capancdt_6200 own", "bk_precision_1785b agilent_34970a own",
)  # fmt: skip
"""What serial_dac is tried with: what drives, what reads, and whether they share a line."""
PIEZO = (
    "pi_e709 V",
    "pi_e727 V",
    "pi_e727_3cd V",
    "npoint_lc400 V",
    "thorlabs_kpz101 thorlabs_ksg101 own V",
    "cobs_board V",
    "icp_m7024_dcon agilent_34970a own V",
    "thorlabs_mdt693b agilent_34970a own V",
    "attocube_anc300 agilent_34970a own V",
)
"""Serial devices that drive a piezo too."""
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
KINDS = {"ascii", "ascii_tcp", "bytes", "frames"}
SETTLED_S = 2e-3
TIMEOUT_S = 1.0
"""A busy machine answers within it; a device without numbered answers is silent for as long."""
STREAM_RATE_HZ = 640.0
BLOCK = 10
FIFO_BLOCKS = 32  # 500 ms, the longest stall of a busy machine
MUST_BE_AT_REST = {"bk_precision_1785b", "kepco_bop", "magna_power_sl", "tdk_lambda_gen"}


def serial_profiles():
    """Return the shipped profiles of serial devices, by name."""
    kinds = {name: load_profile(name).link.kind for name in shipped_profiles()}
    return [name for name, kind in kinds.items() if kind in KINDS]


class DrivenSerial(contract.DrivenDevice):
    """A serial_dac and its emulation, for the checks.

    With a FIFO, the last command is held until all answers have arrived. Without answers, time
    advances only after a command has arrived.
    """

    silent = False
    reach = (-10.0, 10.0)  # of the rig's amplifier

    def exchange(self, command):
        """Exchange any number of samples, a block at a time."""
        late = self.device.info.latency_blocks * self.block
        command = np.asarray(command, dtype=np.float64)
        held = np.full(-command.size % self.block + late, command[-1])
        sent = np.concatenate((command, held)).reshape(-1, self.block)
        before, answers = sent.copy(), []
        for block in sent:
            answers.append(super().exchange(block))
            if self.silent:
                self.assert_stands(float(np.clip(block[-1], *self.reach)))
        assert np.array_equal(sent, before)
        displacement_um, measured = np.concatenate(answers, axis=1)
        return displacement_um[late:][: command.size], measured[: command.size]

    def assert_stands(self, command):
        """Wait for the output, because some commands are not answered."""
        end_s = time.monotonic() + 5.0
        while abs(self.stands() - command) > contract.STEP:
            assert time.monotonic() < end_s, f"{command} A is not output"


def wired(case, tmp_path, stack):
    """Return a serial_dac connected to an emulator of one or two profiles."""
    actuator = PiezoOptions() if case.endswith(" V") else TerfenolOptions()
    name, reader, line = [*case.removesuffix(" V").split(), None, None][:3]
    profile = load_profile(name)
    path = tmp_path / f"{name}.yaml"
    text = shipped_profiles()[name].read_text()
    path.write_text(text.replace("boot_wait_s: 2.0", "boot_wait_s: 0.0"))
    if reader in shipped_profiles():
        text = shipped_profiles()[reader].read_text()
        reader = str(tmp_path / f"{reader}.yaml")
        text = text.replace("boot_wait_s: 2.0", "boot_wait_s: 0.0")
        Path(reader).write_text(text.replace("max_age_s: 0.02", f"max_age_s: {TIMEOUT_S}"))
    if reader == "only_reads":
        reader = str(tmp_path / "only_reads.yaml")
        Path(reader).write_text(ONLY_READS)
    stream = getattr(profile, "exchange", "none") == "stream"
    unasked = case == UNASKED
    clock = time.monotonic_ns if stream or unasked else ManualClock()
    wanted = EmulatorOptions(
        str(path), reader=reader, reader_line=line, rigs=one_rig(actuator=actuator)
    )
    emulator = stack.enter_context(emulated(wanted, clock))
    options = {**emulator.options, "timeout_s": TIMEOUT_S, "fifo_blocks": FIFO_BLOCKS}
    chosen = device_class("serial_dac")
    device = chosen(chosen.Options.model_validate(options))
    stack.callback(device.close)
    rate_hz = STREAM_RATE_HZ if stream else device.info.max_rate_hz
    silent = getattr(profile.outputs[options["output"]], "reply", "") == "none"
    rig = emulator.rigs[0].rig

    def pass_time():
        if unasked:
            time.sleep(2.0 * SETTLED_S)
        elif not stream:
            clock.pass_s(min(1.0 / rate_hz, SETTLED_S))

    block = BLOCK if device.info.latency_blocks else 1
    made = DrivenSerial(device, block, rate_hz, lambda: rig.command, pass_time, name="serial_dac")
    combined = getattr(profile.exchange, "write", "\n")  # of several lines the write is the last
    made.silent = silent and (line == "own" or "\n" in combined)
    if case.endswith(" V"):
        made.reach = (device.info.command_min, device.info.command_max)
    made.must_be_at_rest = name in MUST_BE_AT_REST
    # One returns its last command, not its output; the other measures it too roughly.
    made.reads_back = name not in {"adam_4024_ascii", "thorlabs_mdt693b"}
    return made


@pytest.fixture
def make(tmp_path):
    """Return a factory of devices, which are closed afterwards."""
    with ExitStack() as stack:
        yield lambda name: wired(name, tmp_path, stack)


STREAMS = "cobs_board_fifo"
UNASKED = "kepco_bop capancdt_6200 own"


@pytest.fixture(
    params=[
        # A FIFO drains and a sensor sends in real time.
        pytest.param(case, marks=pytest.mark.slow) if case in {STREAMS, UNASKED} else case
        for case in (*SERIAL, *PIEZO)
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


def test_two_of_a_kind_agree(driven, make, case):
    """The times of samples that are sent unasked differ."""
    if case != UNASKED:
        contract.test_two_of_a_kind_agree(driven, make, case)


def test_no_serial_profile_is_left_out():
    drives = {case.split()[0] for case in (*SERIAL, *PIEZO)}
    reads = {word for case in (*SERIAL, *PIEZO) for word in case.split()[1:2]}
    assert drives | (reads & set(serial_profiles())) == set(serial_profiles())
    assert {load_profile(name).link.kind for name in drives} == KINDS
