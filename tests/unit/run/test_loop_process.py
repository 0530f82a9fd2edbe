"""The loop's process before it has a job, run in this one; and what it imports."""

import signal
import socket
import subprocess
import sys
from types import SimpleNamespace

import pytest

from hilctl.run import carried_out, loop_process
from hilctl.run.waiting_loop import CHECKING


def test_a_job_is_carried_out_with_all_signals_ignored(monkeypatch):
    """Once the kernels of every run are compiled."""
    ignored, done = {}, []

    def carry_out(job):
        assert job == CHECKING + b"what to do"
        assert done == ["ordinary", "loaded"]
        return 7

    ours, theirs = socket.socketpair()
    with ours:
        ours.sendall(b"-" + CHECKING + b"what to do")  # without standard error, see waiting_loop
    standard_input = SimpleNamespace(fileno=theirs.detach)
    monkeypatch.setattr(loop_process.sys, "stdin", standard_input)
    monkeypatch.setattr(loop_process, "be_ordinary", lambda: done.append("ordinary"))
    monkeypatch.setattr(loop_process, "ensure_compiled", lambda *kernels: done.append("loaded"))
    monkeypatch.setattr(loop_process.signal, "signal", ignored.__setitem__)
    monkeypatch.setattr(carried_out, "carry_out", carry_out)
    assert loop_process.main() == 7
    # A stop comes from the supervisor alone, so that it ends by the ramp.
    assert ignored == dict.fromkeys((signal.SIGINT, signal.SIGTERM, signal.SIGHUP), signal.SIG_IGN)


def test_a_process_that_gets_no_job_ends_as_if_it_had_none(monkeypatch):
    ours, theirs = socket.socketpair()
    ours.close()
    monkeypatch.setattr(loop_process.sys, "stdin", SimpleNamespace(fileno=theirs.detach))
    monkeypatch.setattr(loop_process, "be_ordinary", lambda: None)
    monkeypatch.setattr(loop_process.signal, "signal", lambda number, handler: None)
    assert loop_process.main() == 0


BULKY = ("scipy.optimize", "scipy.signal", "scipy.sparse", "matplotlib", "pandas")
LOOP = "hilctl.run.loop_process, hilctl.run.carried_out"
OF_OTHERS = ("scipy.special", "mcap", "google.protobuf", "rich", "typer")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("modules", "left_out"),
    [
        (f"{LOOP}, hilctl_drivers.modbus.device", BULKY + OF_OTHERS),
        (
            f"hilctl.base.plain, {LOOP}, hilctl.models.refined, hilctl_drivers.simulated.rigs",
            (*BULKY, *OF_OTHERS, "pydantic", "pydantic_core", "hilctl.base.yaml"),
        ),
        ("hilctl.cli.run", BULKY),
        ("hilctl.run.client", (*BULKY, *OF_OTHERS, "numpy", "pydantic")),
    ],
    ids=["loop", "plain loop", "supervisor", "client"],
)
def test_it_has_nothing_that_only_others_need(modules, left_out):
    """The loop's is locked in memory; a stop is not to wait for what it does not use."""
    program = f"import sys, {modules};"
    if "loop_process" in modules:  # numba imports some with its first kernel
        program += "from hilctl.kernels import jit, limit; jit.ensure_compiled(limit.limit_block);"
    program += f"print([name for name in {left_out} if name in sys.modules])"
    words = [sys.executable, "-P", "-c", program]
    assert subprocess.run(words, capture_output=True, text=True, check=True).stdout == "[]\n"
