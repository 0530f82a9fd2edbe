"""The last write of a run on a serial line: the safe value, until the device says that it stands.

It comes after something has gone wrong, so nothing is taken for granted: the line may be full of
late answers or never fall silent, the device may be deaf for a while or boot, the port may be gone.
The value is sent before any of this is looked into; what is believed is the device's own answer.
"""

import time
from collections.abc import Callable

from hilctl.base.errors import DeviceError
from hilctl_drivers.wire.serial_port import SerialLink

PATIENCE_S = 3.0
"""How long a device that does not answer is tried, beside the time that it needs to boot."""
_ANSWER_S = 0.5
"""Longest wait for one answer: where the device did not get the value, it must be sent again."""
_PAUSE_S = 0.01
"""Between two tries: a port is free as soon as the process that had it has died."""
_QUIET_S = 0.02
"""First silence that is taken for the end of late answers; doubled with each try, for an answer
that came later than that would pass for the next one's."""


class SerialLastWrite:
    """Sends a value until it is confirmed.

    Args:
        clock: Monotonic time in s.
        sleep: Waits that many s.
    """

    def __init__(
        self,
        clock: Callable[[], float] = time.monotonic,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        self._clock = clock
        self._sleep = sleep

    def carry_out(
        self, link: SerialLink, send: Callable[[], None], confirm: Callable[[], None]
    ) -> None:
        """Send the value, again and again, until the device confirms it.

        Args:
            link: To the device, open or not; a board that opening resets is not waited for.
            send: Sends the value and awaits no answer.
            confirm: Sends it, and raises unless the device says that it stands.

        Raises:
            DeviceError: It was not confirmed in time; the text says why not, the last time.
        """
        deadline_s = self._clock() + PATIENCE_S + link.boot_s
        before_s, link.timeout_s = link.timeout_s, min(link.timeout_s, _ANSWER_S)
        try:
            self._until(deadline_s, link, send, confirm)
        finally:
            link.timeout_s = before_s

    def _until(
        self,
        deadline_s: float,
        link: SerialLink,
        send: Callable[[], None],
        confirm: Callable[[], None],
    ) -> None:
        quiet_s, in_doubt = _QUIET_S, False
        while True:
            try:
                if not link.is_open:
                    link.open(boot=False)
                # The coil first: waiting for a line that is out of step to fall silent takes time,
                # and some never do. After a failure the line is taken to be: the answer to one
                # try would pass for the next one's, and each time again.
                if in_doubt or not link.is_in_step:
                    send()
                    link.await_silence(quiet_s)
                confirm()
                return
            except DeviceError as error:
                if self._clock() >= deadline_s:
                    raise DeviceError(f"not known whether the value stands: {error}") from None
            quiet_s, in_doubt = min(2.0 * quiet_s, _ANSWER_S), True
            self._sleep(_PAUSE_S)
