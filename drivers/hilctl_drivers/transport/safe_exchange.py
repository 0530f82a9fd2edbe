"""The safe value on a stream: tested at open, written in one attempt, read back.

An attempt usually follows a failure: late answers may be on the line, it may never become silent,
and the device may be booting. So the value is sent first and confirmed afterwards. Only the
device's own answer to it counts.
"""

from collections.abc import Callable

from hilctl.base.errors import DeviceError, UnconfirmedError
from hilctl_drivers.profile_base import Range
from hilctl_drivers.transport.stream_link import StreamLink

_QUIET_S = 0.05
"""Silence that is taken as the end of late answers in the first attempt: adapters hold bytes back
for 16 ms, and some devices think as long."""


class SafeExchange:
    """Attempts that first send a value and then request its confirmation.

    Serial protocols do not number their replies, or repeat the numbers: after a failure the answer
    to an older message would be taken for the answer to the next one, and so on. The silence that
    is required grows with each failed attempt, up to the timeout.
    """

    def __init__(self) -> None:
        self._quiet_s = _QUIET_S

    def attempt(
        self, link: StreamLink, send: Callable[[], None], confirm: Callable[[], None]
    ) -> None:
        """Send the value and request its confirmation, once.

        Args:
            link: To the device, open or not; a board that opening resets is not waited for.
            send: Sends the value and awaits no answer.
            confirm: Sends it, and raises unless the device confirms it.
        """
        try:
            if not link.is_open:
                link.open(boot=False)
            if link.is_in_step:
                confirm()
            else:
                send()
                quiet_s = min(self._quiet_s, link.timeout_s)
                link.await_silence(quiet_s, answer_s=link.timeout_s)
                confirm()
                # That answer may have been a late one. Another follows only if this device answers
                # now: it answers in order, and silence came in between.
                link.await_silence(quiet_s)
                confirm()
        except UnconfirmedError:
            raise
        except DeviceError:
            link.doubt()
            self._quiet_s = 2.0 * min(self._quiet_s, link.timeout_s)
            raise
        self._quiet_s = _QUIET_S


def try_out(output: Range, held: float, put: Callable[[], None], how: str) -> None:
    """Write the present output with the message that writes the safe value; nothing moves.

    An output that is out of range is left alone. ``how`` names register or message in errors.
    """
    if not output.min <= held <= output.max:
        return
    try:
        put()
    except DeviceError as error:
        raise DeviceError(f"the safe value cannot be written {how}: {error}") from None


def check_read_back(output: Range, wanted: float, found: float, tolerance: float) -> None:
    """Raise DeviceError unless an output has the written value, within a tolerance."""
    if not abs(found - wanted) <= tolerance:
        raise DeviceError(f"{wanted:g} {output.unit} was written, but {found:g} was read back")
