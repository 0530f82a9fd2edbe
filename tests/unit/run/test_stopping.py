"""The request to stop: a signal to the very process that supervises, and to no other."""

import os
import signal
import subprocess
import sys
from types import SimpleNamespace

import pytest

from hilctl.base.errors import RunError
from hilctl.run.stopping import STOP_SIGNAL, request_stop


@pytest.fixture
def process():
    """A process that ends by the first signal that comes."""
    # What this process ignores, its children do too, until they say otherwise.
    code = (
        f"import signal; signal.signal({STOP_SIGNAL}, signal.SIG_DFL); print(flush=True); input()"
    )
    started = subprocess.Popen(
        [sys.executable, "-c", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    )
    assert started.stdout is not None
    started.stdout.readline()
    yield started
    started.kill()
    started.communicate()


def run(number, *, supervised=True):
    card = SimpleNamespace(name="a", supervisor=number)
    return SimpleNamespace(card=card, supervised=supervised, alive=False)


def test_the_supervisor_gets_the_signal(process):
    assert request_stop(run(process.pid))
    assert process.wait(timeout=60) == -STOP_SIGNAL


def test_a_process_that_holds_no_lock_is_left_alone(process):
    """Its number may be another program's by now."""
    assert not request_stop(run(process.pid, supervised=False))
    assert process.poll() is None


def test_the_lock_is_looked_at_once_the_process_is_held(process, monkeypatch):
    """The other way round, the number could become another's in between."""
    order = []
    opened = os.pidfd_open

    class Going:
        card = SimpleNamespace(name="a", supervisor=process.pid)
        alive = False

        @property
        def supervised(self):
            order.append("lock")
            return True

    monkeypatch.setattr(os, "pidfd_open", lambda pid: order.append("process") or opened(pid))
    request_stop(Going())
    assert order == ["process", "lock"]


def test_a_supervisor_that_is_gone_is_no_error(process):
    process.kill()
    process.wait()
    assert not request_stop(run(process.pid))


def test_what_the_kernel_refuses_is_told(process, monkeypatch):
    def refuse(*_):
        raise PermissionError(1, "Operation not permitted")

    monkeypatch.setattr(signal, "pidfd_send_signal", refuse)
    with pytest.raises(RunError, match="a: can't be stopped: Operation not permitted"):
        request_stop(run(process.pid))
