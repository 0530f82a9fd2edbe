"""Faults in runs that stream over Modbus: one safe ramp, according to the device."""

import os
import signal

import numpy as np
import pytest

from hilctl.base.samples import Flag
from tests.faults.conftest import T7, each_kind, tcp

TIMEOUT_S = 2.0
WATCHDOG_S = 4.0
FAULT_AT = 120
BLOCK = 200
FIFO_BLOCKS = 12
STREAM = {"sample_rate_hz": 5000, "block": BLOCK}
STREAMING = {
    "kind": "modbus_stream",
    "timeout_s": TIMEOUT_S,
    "fifo_blocks": FIFO_BLOCKS,
    "watchdog": {"timeout_s": WATCHDOG_S},
}
FAULTS = {
    "silence": "no answer within 2 s",
    "exception": "function 76 refused with exception 4 (device failure)",
    "corrupt": "not a Modbus TCP header",
    "reset": "connection lost: connection reset by peer",
}


def over_tcp(address):
    return {**T7, **STREAMING, **tcp(address)}


def assert_made_safe(device):
    """Assert that the safe value was written last, with no output after it."""
    events = device.log.events("DAC0")
    last = max(k for k, each in enumerate(events) if each["event"] == "write")
    assert {each["event"] for each in events[last + 1 :]} <= {"watchdog"}
    assert [each["current_a"] for each in events[last:]] == pytest.approx(
        [0.0] * (len(events) - last), abs=1e-5
    )


@pytest.mark.parametrize("fault", each_kind(FAULTS, {"silence", "corrupt"}))
def test_fault_ends_the_run_safely(emulate, run, fault):
    """A fault is reported in one line, and the safe value replaces queued samples."""
    device = emulate("labjack_t7", "--fault", f"{fault}@{FAULT_AT}")
    started = run(over_tcp(device.address), **STREAM)
    printed = started.end()
    assert printed["code"] == "fault"
    assert printed["output_state"] in {"confirmed", "set"}
    said = printed["reason"]
    assert said.startswith(f"modbus_stream labjack_t7 at {device.address}: ")
    assert FAULTS[fault] in said
    assert "DAC0 and AIN0" in said
    assert "\n" not in said
    assert_made_safe(device)
    recording = started.assert_recorded(at_least=10 * BLOCK)
    unanswered = (recording.samples.flags & Flag.SENSOR_INVALID) != 0
    assert FIFO_BLOCKS * BLOCK <= unanswered.sum() <= (FIFO_BLOCKS + 1) * BLOCK
    assert np.isfinite(recording.samples.displacement_um[~unanswered]).all()


def test_pulled_cable_leaves_it_to_the_watchdog(emulate, run):
    """The run reports a lost connection, and the device's watchdog sets the safe value."""
    device = emulate("labjack_t7", "--fault", f"unplug@{FAULT_AT}")
    printed = run(over_tcp(device.address), **STREAM).end()
    trip = device.log.await_event("DAC0", "watchdog")
    assert printed["output_safe"] is False
    assert "not be confirmed" in printed["reason"]
    assert trip["current_a"] == pytest.approx(0.0, abs=1e-5)


def test_killed_loop_is_made_safe_by_the_supervisor(emulate, run):
    """The supervisor's own connection stops the stream of a killed loop."""
    device = emulate("labjack_t7")
    started = run(over_tcp(device.address), **STREAM)
    device.log.await_events("DAC0", FAULT_AT, started.process)
    os.kill(started.loop_pid(), signal.SIGKILL)
    printed = started.end()
    assert "killed by SIGKILL" in printed["reason"]
    assert printed["output_state"] in {"confirmed", "set"}
    assert_made_safe(device)
