"""Faults in runs over Modbus: one safe ramp, according to the device's log."""

import os
import signal
import time
from pathlib import Path

import numpy as np
import pytest
import yaml

from hilctl.experiment.state_files import DeviceState, MachineTime
from hilctl.recording.run_summary import read_ends
from hilctl.run.recovery import recover_dead_runs
from hilctl.run.start import checked_run
from hilctl.run.supervisor import Supervisor
from tests.faults.conftest import MODULE, PATIENT_DEVICE, PATIENT_TIMING, T7, each_kind, tcp

EXPERIMENT = {
    "name": "exchanged",
    "waveform": {"kind": "sine", "unit": "A", "amplitude": 4.0, "frequency_hz": 2.0},
    "compensator": "none",
    "limits": {"peak_current_a": 5.0, "slew_a_per_s": 500.0, "stroke_um": [-100.0, 100.0]},
    "safe": {"value": 0.0, "ramp_s": 0.2},
}
TIMEOUT_S = 2.0
WATCHDOG_S = 4.0
FAULT_AT = 250
GUARDED = {"timeout_s": TIMEOUT_S, "watchdog": {"timeout_s": WATCHDOG_S}}


def over_tcp(address: str) -> dict:
    return {**T7, **GUARDED, **tcp(address)}


def over_rtu(profile: str, port: str) -> dict:
    return {**MODULE, "timeout_s": TIMEOUT_S, "profile": profile, "serial_port": port}


def left() -> DeviceState:
    """Return the device state file of the test's device."""
    (path,) = Path(os.environ["XDG_STATE_HOME"]).glob("hilctl/devices/*.json")
    return DeviceState.model_validate_json(path.read_text())


TCP_FAULTS: dict[str, str] = {
    "silence": "no answer",
    "delay:6": "no answer",
    "late:3": "no answer",
    "exception": "function 76 refused with exception 4 (device failure)",
    "corrupt": "not a Modbus TCP header",
    "reset": "connection lost: connection reset by peer",
}
"""Faults during a run; faults of the driver alone are in ``test_register_wire.py``."""


@pytest.mark.parametrize("fault", each_kind(TCP_FAULTS, {"silence", "late:3", "corrupt"}))
def test_tcp_fault_ends_the_run_safely(emulate, run, fault):
    """The run stops in time with one line on the fault, and the output is at the safe value."""
    device = emulate("labjack_t7", "--fault", f"{fault}@{FAULT_AT}")
    started = run(over_tcp(device.address))
    printed = started.end()
    # The unanswered command may be executed now; the guardian repeats the safe value.
    writes = device.log.await_output("DAC0", 0.0)
    assert printed["code"] == "fault"
    assert (printed["output_state"], printed["guardian_active"]) == ("set", True)
    said = printed["reason"]
    assert said.startswith(f"modbus_dac labjack_t7 at {device.address}: ")
    assert TCP_FAULTS[fault] in said
    assert "read AIN0" in said
    assert "\n" not in said
    waits_s = np.diff([each["unix_s"] for each in writes])
    assert waits_s.max() < 2.0 * TIMEOUT_S
    started.assert_put_out(writes)


@pytest.mark.parametrize("delay_s", [0.3, 1.5])
def test_slow_answer_names_the_limit_that_ends_the_run(emulate, run, delay_s):
    """It is within the timeout of the device: the loop ends the run, or is killed."""
    device = emulate("labjack_t7", "--fault", f"delay:{delay_s}@{FAULT_AT}")
    started = run(over_tcp(device.address), timing={"max_late_s": 0.1})
    printed = started.end()
    assert "timing.max_late_s (0.1 s" in printed["reason"]
    started.assert_put_out(device.log.await_output("DAC0", 0.0))


def test_pulled_cable_leaves_it_to_the_watchdog(emulate, run):
    """The run reports a lost connection, and the device's watchdog sets the safe value."""
    device = emulate("labjack_t7", "--fault", f"unplug@{FAULT_AT}")
    started = run(over_tcp(device.address))
    printed = started.end()
    trip = device.log.await_event("DAC0", "watchdog")
    writes = device.log.writes("DAC0")
    assert printed["output_safe"] is False
    assert "no answer" in printed["reason"]
    assert "not be confirmed" in printed["reason"]
    assert trip["current_a"] == pytest.approx(0.0, abs=1e-5)
    silent_s = (trip["monotonic_ns"] - writes[-1]["monotonic_ns"]) * 1e-9
    assert 0.99 * WATCHDOG_S < silent_s < 2.0 * WATCHDOG_S
    started.assert_put_out(writes)


@pytest.mark.parametrize(("fault", "words", "state"), [
    ("silence", "no answer", "set"),
    pytest.param(
        "exception", "function 23 refused with exception 4", "set", marks=pytest.mark.long),
    ("corrupt", "CRC of 9 bytes is wrong", "set"),
    ("unplug", "port lost, unplugged?", "unknown"),
])  # fmt: skip
def test_rtu_fault_ends_the_run(emulate, run, profile, fault, words, state):
    """The same on a serial line, where an unplugged adapter removes its port."""
    module = profile("rtu_module")
    device = emulate(module, "--fault", f"{fault}@120")
    started = run(over_rtu(module, device.address), sample_rate_hz=150)
    printed = started.end()
    writes = device.log.events("OUT")
    assert printed["output_state"] == state
    assert printed["reason"].startswith(f"modbus_dac {module} at {device.address}: ")
    assert words in printed["reason"]
    if state == "set":
        assert writes[-1]["current_a"] == 0.0
    started.assert_put_out(writes)


def test_killed_loop_is_made_safe_by_the_supervisor(emulate, run):
    """The supervisor sets the safe value over its own connection."""
    device = emulate("labjack_t7")
    started = run(over_tcp(device.address))
    device.log.await_events("DAC0", FAULT_AT, started.process)
    os.kill(started.loop_pid(), signal.SIGKILL)
    printed = started.end()
    assert "killed by SIGKILL" in printed["reason"]
    assert printed["output_state"] in {"confirmed", "set"}  # set if it was killed in an exchange
    assert device.log.writes("DAC0")[-1]["current_a"] == pytest.approx(0.0, abs=1e-5)


def test_dead_host_is_noticed_by_the_device(emulate, run):
    """With all processes killed, the device's watchdog sets the safe value in time."""
    device = emulate("labjack_t7")
    started = run(over_tcp(device.address))
    # Long enough for the recording to be flushed.
    device.log.await_events("DAC0", 2 * FAULT_AT, started.process)
    started.kill_all(signal.SIGKILL)
    trip = device.log.await_event("DAC0", "watchdog")
    last = device.log.writes("DAC0")[-1]
    assert trip["current_a"] == pytest.approx(0.0, abs=1e-5)
    silent_s = (trip["monotonic_ns"] - last["monotonic_ns"]) * 1e-9
    assert 0.99 * WATCHDOG_S < silent_s < 2.0 * WATCHDOG_S
    assert started.readable_samples() > 100
    # As after a power cut, the run is the device's last and its end is unknown.
    begun = left()
    assert (begun.recording, begun.coil) == (str(started.output), None)
    (orphan,) = recover_dead_runs()
    assert not orphan.safe
    assert (left().coil, left().boot_s <= MachineTime.now().boot_s) == (None, True)
    assert begun.boot_s > left().boot_s


def test_a_killed_supervisor_leaves_the_heat_of_the_coil(emulate, run):
    """The next command computes it from the recovered samples, before it reads the state."""
    device = emulate("labjack_t7")
    started = run(over_tcp(device.address))
    device.log.await_events("DAC0", FAULT_AT, started.process)
    started.process.kill()
    started.process.communicate(timeout=240)
    device.log.await_output("DAC0", 0.0)
    until_s = time.monotonic() + 30.0
    while not (found := recover_dead_runs()) and time.monotonic() < until_s:
        time.sleep(0.1)
    assert found[0].safe
    state = left()
    assert (state.recording, state.coil.output_safe) == (str(started.output), True)
    assert state.boot_s <= MachineTime.now().boot_s
    assert read_ends(started.output).end["code"] == "stopped"


def test_second_run_on_the_same_device_is_refused(emulate, run):
    """A second run names the first, also by another host name; the first continues."""
    device = emulate("labjack_t7")
    section = {**over_tcp(device.address), **PATIENT_DEVICE}
    first = run(section, timing=PATIENT_TIMING)
    device.log.await_events("DAC0", FAULT_AT, first.process)
    said = run({**section, "host": "localhost"}, name="second").refused()
    who = f"run wire_fault (process {first.process.pid}, recording {first.output})"
    assert who in said
    seen = len(device.log.events("DAC0"))
    device.log.await_events("DAC0", seen + 50, first.process)
    printed = first.interrupt()
    assert printed["code"] == "stopped"
    assert (left().recording, left().coil.output_safe) == (str(first.output), True)
    assert printed["dropped"] == printed["skipped_ticks"]  # a busy machine may be late


def test_profile_exchanged_after_the_check_changes_nothing(emulate, tmp_path, profile):
    """The loop process uses the checked profile and reads none from disk."""
    device = emulate(profile("rtu_module"))
    mine = tmp_path / "mine.yaml"
    mine.write_text(Path(profile("rtu_module")).read_text())
    section = over_rtu(mine.name, device.address)
    waveform = {**EXPERIMENT["waveform"], "duration_s": 0.5}
    path = tmp_path / "run.yaml"
    changes = {"sample_rate_hz": 50, "device": section, "waveform": waveform}
    path.write_text(yaml.safe_dump({**EXPERIMENT, **changes}), encoding="utf-8")
    checked = checked_run(path, ())
    mine.write_text(mine.read_text().replace("address: 100", "address: 90"))
    output = tmp_path / "run.mcap"
    result = Supervisor(checked, output, overwrite=False, on_progress=lambda _: None).run()
    assert result.code == "completed"
    put_out = [each["current_a"] for each in device.log.writes("OUT")]
    assert max(put_out) == pytest.approx(4.0, abs=0.2)
