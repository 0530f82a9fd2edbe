"""Notifications to systemd: ready, watchdog, stopping; none without a service manager."""

import os
import socket
import time
from collections.abc import Callable, Mapping
from contextlib import suppress


class Notifier:
    """Speaks the sd_notify(3) protocol.

    Args:
        environment: ``NOTIFY_SOCKET`` and ``WATCHDOG_USEC`` are looked up here.
        clock: Monotonic time in s.
    """

    def __init__(
        self,
        environment: Mapping[str, str] = os.environ,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        address = environment.get("NOTIFY_SOCKET", "")
        self._address = "\0" + address[1:] if address.startswith("@") else address
        self._clock = clock
        self._next_s = clock()
        try:
            self._every_s = int(environment.get("WATCHDOG_USEC", "0")) * 1e-6 / 3.0
        except ValueError:
            self._every_s = 0.0

    def say(self, *lines: str) -> None:
        """Send lines such as ``READY=1``; one that can't be sent is not worth a run."""
        if not self._address:
            return
        with suppress(OSError), socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as out:
            out.setblocking(False)
            out.sendto("\n".join(lines).encode(), self._address)

    def alive(self) -> None:
        """Feed the watchdog, three times in its interval; to be called more often than that."""
        if self._every_s and self._clock() >= self._next_s:
            self._next_s = self._clock() + self._every_s
            self.say("WATCHDOG=1")
