"""Guardian and supervisor without descriptors or memory: the output must become safe."""

import os
import resource
import signal
from contextlib import suppress

import pytest

from tests.fakes import children_of
from tests.faults.conftest import MODULE, T7, each_kind, tcp

LIMITS = {
    "descriptors": (resource.RLIMIT_NOFILE, 3),
    "memory": (resource.RLIMIT_AS, 4096),
}
PORTS = {"tcp": ("labjack_t7", "DAC0"), "serial": ("rtu_module", "OUT")}


@pytest.fixture
def started(emulate, run, profile):
    """Return a function that starts a run on an emulated device; with its output's name."""

    def start(port):
        name, output = PORTS[port]
        device = emulate(name if port == "tcp" else profile(name))
        if port == "tcp":
            section = {**T7, **tcp(device.address)}
        else:
            section = {**MODULE, "profile": profile(name), "serial_port": device.address}
        made = run(section, sample_rate_hz=100)
        device.log.await_events(output, 100, made.process)
        return device, output, made

    return start


CASES = [(port, what) for port in PORTS for what in LIMITS]


@pytest.fixture
def exhaust():
    """Return a function that limits guardian and supervisor of a run, and kills its loop."""
    guardians = []

    def limit(made, kind, most):
        loop = made.loop_pid()
        (guardian,) = set(children_of(made.process.pid)) - {loop}
        guardians.append(os.pidfd_open(guardian))
        for pid in (made.process.pid, guardian):
            resource.prlimit(pid, kind, (most, most))
        os.kill(loop, signal.SIGKILL)

    yield limit
    for each in guardians:  # a supervisor without descriptors leaves no run that can be found
        with suppress(ProcessLookupError):
            signal.pidfd_send_signal(each, signal.SIGKILL)
        os.close(each)


@pytest.mark.parametrize(("port", "what"), each_kind(CASES, {CASES[0], CASES[-1]}))
def test_an_exhausted_guardian_sets_the_safe_value(started, exhaust, port, what):
    device, output, made = started(port)
    exhaust(made, *LIMITS[what])
    device.log.await_output(output, 0.0)
    made.end()


@pytest.mark.long
def test_a_run_ends_if_no_process_can_act(started, exhaust):
    """With a limit of 0 even standard input is no reserve, and poll() fails."""
    _, _, made = started("tcp")
    exhaust(made, resource.RLIMIT_NOFILE, 0)
    made.process.communicate(timeout=240.0)
    assert made.process.returncode == 3
