"""Time limits for code that may never return."""

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager

PATIENCE_S = 60.0
"""Timeout of calls that move nothing, in s; some packages take long to load."""


@contextmanager
def alarm(call: Callable[[], None], every_s: float) -> Iterator[None]:
    """Call a function periodically between two Python instructions; it may raise.

    It is called only in the main thread, and only on systems with timers.
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
    """Raise TimeoutError after :data:`PATIENCE_S` if :func:`alarm` works here."""

    def expired() -> None:
        raise TimeoutError(f"it has not returned within {PATIENCE_S:g} s")

    with alarm(expired, PATIENCE_S):
        yield
