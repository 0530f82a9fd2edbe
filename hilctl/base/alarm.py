"""Time limits for code that may never return."""

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager

PATIENCE_S = 60.0
"""Longest time of a call that moves nothing, in s: some packages load for a long time."""


@contextmanager
def alarm(call: Callable[[], None], every_s: float) -> Iterator[None]:
    """Call a function every so many seconds, between two steps of Python; it may raise there.

    Only in the main thread, and only on systems with timers; otherwise it is never called.
    """
    timers = hasattr(signal, "setitimer")
    if not timers or threading.current_thread() is not threading.main_thread():
        yield
        return
    handler = signal.signal(signal.SIGALRM, lambda number, frame: call())
    timer = signal.setitimer(signal.ITIMER_REAL, every_s, every_s)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, *timer)
        signal.signal(signal.SIGALRM, handler or signal.SIG_DFL)


@contextmanager
def time_limit() -> Iterator[None]:
    """Raise TimeoutError after :data:`PATIENCE_S`, where :func:`alarm` works."""

    def expired() -> None:
        raise TimeoutError(f"it has not returned within {PATIENCE_S:g} s")

    with alarm(expired, PATIENCE_S):
        yield
