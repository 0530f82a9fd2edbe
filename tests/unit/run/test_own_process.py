"""Runs of programs that have threads."""

import signal
import threading

import pytest

from hilctl.base.errors import ConfigError, ConfigProblem, InputError, RunError
from hilctl.run import own_process
from hilctl.run.own_process import has_threads, run_in_own_process

GIVEN = ("x.yaml", (), None, False, 0.0)


@pytest.fixture
def answering(monkeypatch):
    """Return a function that says what the process of a run does, in Python."""

    def says(code):
        start = "import os, pickle, signal, sys; answers = os.fdopen(int(sys.argv[1]), 'wb')"
        monkeypatch.setattr(own_process, "_START", f"{start}\n{code}")

    return says


def in_a_thread(function):
    found = []
    thread = threading.Thread(target=lambda: found.append(function()))
    thread.start()
    thread.join()
    return found[0]


def test_threads_are_seen():
    assert in_a_thread(has_threads)


def test_errors_come_back_as_they_are(answering):
    answering(
        "from hilctl.base.errors import ConfigError, ConfigProblem\n"
        "error = ConfigError([ConfigProblem('x.yaml:1', 'name', 'is required')])\n"
        "pickle.dump(error, answers)"
    )
    with pytest.raises(ConfigError) as refused:
        run_in_own_process(GIVEN, print)
    assert refused.value.problems == (ConfigProblem("x.yaml:1", "name", "is required"),)


@pytest.mark.parametrize("code", ["", "answers.write(b'cut')", "os._exit(7)"])
def test_process_that_ends_without_a_result_is_a_run_error(answering, code):
    answering(code)
    with pytest.raises(RunError, match=r"ended with code [07] and without a result"):
        run_in_own_process(GIVEN, print)


def test_interrupt_is_passed_on_and_handlers_are_as_before(answering):
    answering("import time\nsignal.signal(2, 0)\nos.kill(os.getppid(), 2)\ntime.sleep(60)")
    before = signal.getsignal(signal.SIGINT)
    with pytest.raises(KeyboardInterrupt):
        run_in_own_process(GIVEN, print)
    assert signal.getsignal(signal.SIGINT) is before


def test_display_that_fails_ends_no_run(answering):
    answering("from hilctl.run.result import Progress\nfrom hilctl.base.errors import InputError\n"
              "for k in range(9): pickle.dump(Progress(k, 9, 0, True, bytes(100_000)), answers)\n"
              "pickle.dump(InputError('done'), answers)")  # fmt: skip
    shown = []

    def show(progress):
        shown.append(progress.samples)
        raise ValueError

    with pytest.raises(InputError, match="done"):
        run_in_own_process(GIVEN, show)
    assert shown == [0]
