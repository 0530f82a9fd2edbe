"""Alarms end code that does not return, and leave no trace."""

import signal
import threading

import pytest

from hilctl.base.alarm import alarm, time_limit


def test_code_that_exceeds_the_limit_is_interrupted():
    with pytest.raises(TimeoutError), time_limit():
        signal.raise_signal(signal.SIGALRM)


def test_handler_and_timer_are_restored():
    before = signal.getsignal(signal.SIGALRM)
    timer_s, interval_s = signal.getitimer(signal.ITIMER_REAL)
    calls = []
    with alarm(lambda: calls.append(1), 1000.0):
        signal.raise_signal(signal.SIGALRM)
    assert calls == [1]
    assert signal.getsignal(signal.SIGALRM) is before
    left_s, same_s = signal.getitimer(signal.ITIMER_REAL)
    assert same_s == interval_s
    assert (0.0 < left_s <= timer_s) or (left_s, timer_s) == (0.0, 0.0)


def test_other_threads_are_not_interrupted():
    found = []

    def work():
        with time_limit():
            found.append(signal.getitimer(signal.ITIMER_REAL)[1])

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert found == [signal.getitimer(signal.ITIMER_REAL)[1]]
