"""How the loop's process ended, or why it never started."""

import signal
import subprocess
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import Mock

import pytest

from hilctl.base.errors import InputError, RunError
from hilctl.run import processes as module
from hilctl.run.processes import LoopProcess
from hilctl.run.shared.ring import SampleRing
from hilctl.run.shared.shared_page import PageField, PageSlot, Phase


class FakeProcess:
    """A process that has ended with a code, or lives where that is None."""

    code = None

    def poll(self):
        return self.code

    wait = poll


@pytest.fixture
def started(tmp_path, monkeypatch):
    process = FakeProcess()

    def start_process(*words, inherits):
        process.words, process.inherits = words, inherits
        return process

    monkeypatch.setattr(module, "start_process", start_process)
    ring = SampleRing.create(tmp_path / "ring", slots=4, block=1, state_size=1)
    return LoopProcess(SimpleNamespace(job=Path("job")), ring.page, (5, 6)), ring.page


def never():
    return False


def test_the_job_is_given_with_the_locks(started):
    process = started[0]._process
    assert process.words == ("hilctl.run.loop_process", "job")
    assert process.inherits == (5, 6)


def test_a_loop_process_that_cannot_be_started_is_an_error_of_the_run(tmp_path, monkeypatch):
    monkeypatch.setattr(
        module, "start_process", Mock(side_effect=OSError(24, "Too many open files"))
    )
    with pytest.raises(RunError, match="Too many open files"):
        LoopProcess(SimpleNamespace(job=Path("job")), None, ())


@pytest.mark.parametrize(
    ("phase", "error"), [(Phase.REFUSED, InputError), (Phase.FAILED, RunError)]
)
def test_a_loop_that_can_not_start_says_why(started, phase, error):
    child, page = started
    page.write_text(PageSlot.ERROR, "no port")
    page.put(PageField.PHASE, phase)
    with pytest.raises(error, match="no port"):
        child.await_ready(never)


def test_a_loop_that_died_before_the_start_is_told_by_its_signal(started):
    child, _ = started
    child._process.code = -signal.SIGKILL
    with pytest.raises(RunError, match="died before the start: killed by SIGKILL"):
        child.await_ready(never)


def test_a_stop_comes_before_the_start(started):
    child, page = started
    with pytest.raises(RunError, match="stopped before the start; nothing has moved"):
        child.await_ready(lambda: True)
    page.put(PageField.PHASE, Phase.READY)
    child.await_ready(lambda: True)


def test_a_loop_that_died_or_broke_says_what_it_can(started):
    child, page = started
    child._process.code = 7
    assert child.death() == "the loop process died: exit code 7"
    child._process.code = -signal.SIGSEGV
    assert child.death() == "the loop process died: killed by SIGSEGV"
    page.write_text(PageSlot.ERROR, "the loop broke: ZeroDivisionError")
    page.put(PageField.PHASE, Phase.FAILED)
    assert child.death() == "the loop broke: ZeroDivisionError"


def test_a_loop_that_the_kernel_keeps_is_not_waited_for(started):
    child, _ = started

    def wait(timeout):
        raise subprocess.TimeoutExpired("loop", timeout)

    child._process.wait, child._process.kill = wait, lambda: None
    child.kill()
    assert "blocked in the kernel" in child.death()
