"""Faults in runs over text lines and board frames: one safe ramp."""

import os
import re
import signal
import subprocess
import time
from pathlib import Path

import numpy as np
import pytest

from hilctl_drivers.profile import shipped_profiles
from tests.faults.conftest import PATIENT_DEVICE, PATIENT_TIMING, each_kind, sine

TIMEOUT_S = 2.0
WITHOUT_PRIVILEGES = ["setpriv", "--inh-caps=-all", "--bounding-set=-all"]
WATCHDOG_S = 4.0
WAVEFORM = sine(1.0, 60.0, soft_start_s=0.2)
GUARDED = {"watchdog": {"timeout_s": WATCHDOG_S}}
DEVICE = {
    "kind": "serial_dac",
    "timeout_s": TIMEOUT_S,
    "amplifier": {"gain_a_per_v": 1.0},
    "sensor": {"um_per_v": 12.5},
    "watchdog": "none",
}
SETUPS = {
    "dcon": ({**GUARDED, "output": "AO0", "input": "AI0"}, {"sample_rate_hz": 100}),
    "scpi": ({"output": "DAC204", "input": "AI101"}, {"sample_rate_hz": 20}),
    "cobs": ({**GUARDED, "output": "DAC", "input": "ADC"}, {"sample_rate_hz": 200}),
    "fifo": (
        {**GUARDED, "output": "DAC", "input": "ADC", "fifo_blocks": 15},
        {"sample_rate_hz": 10_000, "block": 100},
    ),
}
GAINS = {"scpi": {"gain_a_per_v": 10.0 / 12.0}}
FAULT_AT = {"dcon": 81, "scpi": 32, "cobs": 60, "fifo": 80}


@pytest.fixture
def boards(tmp_path, profile):
    """Return the profile of each kind; the test board boots immediately."""
    found = {"dcon": profile("dcon_module"), "scpi": "agilent_34970a"}
    for kind, name in {"cobs": "cobs_board", "fifo": "cobs_board_fifo"}.items():
        text = shipped_profiles()[name].read_text(encoding="utf-8")
        path = tmp_path / f"{name}.yaml"
        path.write_text(text.replace("boot_wait_s: 2.0", "boot_wait_s: 0.0"), encoding="utf-8")
        found[kind] = str(path)
    return found


@pytest.fixture
def meet(emulate, run, boards):
    """Return a function that starts an emulated device and a run on it."""

    def start(kind, *faults, patient=False):
        words = [word for fault in faults for word in ("--fault", f"{fault}@{FAULT_AT[kind]}")]
        device = emulate(boards[kind], *words)
        options, changes = SETUPS[kind]
        section = {**DEVICE, "profile": boards[kind], "serial_port": device.address, **options}
        section["amplifier"] = GAINS.get(kind, section["amplifier"])
        if patient:
            section |= PATIENT_DEVICE
            changes = {**changes, "timing": PATIENT_TIMING}
        return device, run(section, waveform=WAVEFORM, **changes), options["output"]

    return start


FAULTS = {
    ("dcon", "silence"): "no answer within 2 s",
    ("dcon", "corrupt"): "checksum of",
    ("dcon", "exception"): r"invalid command \(\?02\)",
    ("scpi", "cut"): "within 2 s",
    ("cobs", "cut"): "within 2 s",
    ("cobs", "exception"): "refused by the board",
    ("fifo", "silence"): "no answer within 2.01 s",
    ("fifo", "corrupt"): "crc16_ccitt_false|COBS",
    ("fifo", "exception"): "refused by the board",
}
"""Each kind of wire with each way in which a run meets trouble; more of them by themselves, without
a run, are in ``tests/unit/drivers``."""


SHOWN = {("dcon", "corrupt"), ("scpi", "cut"), ("cobs", "exception"), ("fifo", "silence")}


@pytest.mark.parametrize(("kind", "fault"), each_kind(FAULTS, SHOWN))
def test_fault_ends_the_run_safely(meet, boards, kind, fault):
    """The run stops in time, one line names device and fault, and the coil is at 0 A."""
    device, started, output = meet(kind, fault)
    printed = started.end()
    # An armed watchdog may have tripped since.
    events = [each for each in device.log.events(output) if each["event"] != "watchdog"]
    assert printed["code"] == "fault"
    assert printed["output_state"] == "set"  # the unanswered command may still be executed
    said = printed["reason"]
    assert said.startswith(f"serial_dac {boards[kind]} at {device.address}: ")
    assert re.search(FAULTS[kind, fault], said)
    assert f"(to write {output}, read " in said
    assert "\n" not in said
    assert events[-1]["event"] == ("safe" if kind in {"cobs", "fifo"} else "write")
    assert events[-1]["current_a"] == pytest.approx(0.0, abs=2e-3)
    assert events[-1]["unix_s"] - events[-2]["unix_s"] < 2.0 * TIMEOUT_S
    if kind == "fifo":
        started.assert_recorded(at_least=5000)
    else:
        # The last writes are the safe value, repeated after a lost answer.
        writes = device.log.writes(output)
        moving = np.flatnonzero([abs(each["current_a"]) > 2e-3 for each in writes])
        started.assert_put_out(writes[: moving[-1] + 1], at_least=20)


@pytest.mark.parametrize("kind", each_kind(SETUPS, {"dcon", "fifo"}))
def test_pulled_adapter_takes_the_port_along(meet, kind):
    """The run reports a lost port, and a watchdog sets the safe value."""
    device, started, output = meet(kind, "unplug")
    printed = started.end()
    assert printed["output_safe"] is False
    assert "port lost, unplugged?" in printed["reason"]
    assert "not be confirmed" in printed["reason"]
    assert "\n" not in printed["reason"]
    started.assert_recorded(at_least=20)
    if kind == "scpi":  # without a watchdog the voltage persists
        assert device.log.events(output)[-1]["event"] == "write"
        return
    trip = device.log.await_event(output, "watchdog")
    assert trip["current_a"] == pytest.approx(0.0, abs=2e-3)


@pytest.mark.parametrize(("kind", "events"), [("dcon", 80), ("cobs", 80), ("fifo", 300)])
def test_safe_value_is_sent_after_the_death_of_the_loop(meet, boards, kind, events):
    """The supervisor sets the safe value without a reboot of the board."""
    for name in ("cobs", "fifo"):
        path = Path(boards[name])
        path.write_text(path.read_text().replace("boot_wait_s: 0.0", "boot_wait_s: 2.0"))
    device, started, output = meet(kind)
    device.log.await_events(output, events, started.process)
    killed_ns = time.monotonic_ns()
    os.kill(started.loop_pid(), signal.SIGKILL)
    printed = started.end()
    assert printed["output_state"] in {"confirmed", "set"}  # set if it was killed in an exchange
    since = [each for each in device.log.events(output) if each["monotonic_ns"] > killed_ns]
    safe = next(each for each in since if abs(each["current_a"]) < 2e-3)
    assert safe["event"] == ("write" if kind == "dcon" else "safe")
    assert (safe["monotonic_ns"] - killed_ns) * 1e-9 < WATCHDOG_S


@pytest.mark.parametrize(("kind", "events"), [("dcon", 80), ("fifo", 300)])
def test_dead_host_is_noticed_by_the_device(meet, kind, events):
    """With all processes killed, the device's watchdog sets the safe value in time."""
    device, started, output = meet(kind)
    # Long enough for the recording to be flushed.
    device.log.await_events(output, events, started.process)
    started.kill_all(signal.SIGKILL)
    last = device.log.events(output)[-1]
    trip = device.log.await_event(output, "watchdog")
    assert trip["current_a"] == pytest.approx(0.0, abs=2e-3)
    assert (trip["monotonic_ns"] - last["monotonic_ns"]) * 1e-9 < 2.0 * WATCHDOG_S
    assert started.readable_samples() > 20


def test_silent_sensor_device_is_named(emulate, run):
    """With two devices the message names the one that did not answer."""
    sensor = "agilent_34970a:AI101"
    device = emulate("kepco_bop", "--sensor", sensor, lines=2)
    section = {
        "kind": "serial_dac",
        "profile": "kepco_bop",
        "serial_port": device.addresses[0],
        "output": "current",
        "input": "AI101",
        "reader": {"profile": "agilent_34970a", "serial_port": device.addresses[1]},
        "measure": "current",
        "timeout_s": TIMEOUT_S,
        "sensor": {"um_per_v": 12.5},
        "watchdog": "none",
    }
    started = run(section, waveform=WAVEFORM, sample_rate_hz=19)
    device.log.await_events("current", 20, started.process)
    device.process.send_signal(signal.SIGSTOP)
    try:
        printed = started.end()
    finally:
        device.process.send_signal(signal.SIGCONT)
    assert printed["reason"].startswith(f"serial_dac kepco_bop at {device.addresses[0]}: ")
    recording = started.assert_recorded(at_least=10)
    samples = recording.samples
    assert samples.measured[:10] == pytest.approx(samples.command[:10], abs=1e-3)


@pytest.mark.parametrize("kind", ["dcon", pytest.param("fifo", marks=pytest.mark.long)])
def test_second_run_on_the_same_port_is_refused(meet, run, tmp_path, boards, kind):
    """A second run on the port is rejected, also by another port name; the first continues."""
    device, first, output = meet(kind, patient=True)
    device.log.await_events(output, 40, first.process)
    other = tmp_path / "by-id"
    other.symlink_to(device.address)
    options, changes = SETUPS[kind]
    section = {**DEVICE, "profile": boards[kind], "serial_port": str(other), **options}
    said = run(section, name="second", waveform=WAVEFORM, **changes).refused()
    who = f"run wire_fault (process {first.process.pid}, recording {first.output})"
    assert f"serial:{device.address} " in said
    assert who in said
    printed = first.interrupt()
    assert printed["code"] == "stopped"
    assert printed["dropped"] == printed["skipped_ticks"]  # a busy machine may be late


@pytest.mark.skipif(os.geteuid() != 0, reason="only a privileged run keeps a pty to itself")
def test_another_program_cannot_open_the_port(meet):
    """An unprivileged program cannot open the port during a run, and can afterwards."""
    device, first, output = meet("dcon", patient=True)
    device.log.await_events(output, 40, first.process)

    def write():
        return subprocess.run(
            [*WITHOUT_PRIVILEGES, "sh", "-c", f"echo > {device.address}"],
            capture_output=True,
            text=True,
        )

    refused = write()
    assert refused.returncode != 0
    assert "busy" in refused.stderr
    assert first.interrupt()["code"] == "stopped"
    assert write().returncode == 0
