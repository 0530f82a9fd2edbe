"""Link over bytes without framing: the base of serial ports and TCP streams.

Protocols on such a link do not number their replies, so a late reply would pass for the next one.
"""

import array
import math
import select
import time
from abc import ABC, abstractmethod
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from os import read, write

from hilctl.base.errors import DeviceError
from hilctl_drivers.transport.links import (
    ECHOED,
    CorruptError,
    LostError,
    Missing,
    NoAnswerError,
    cut,
    wait_ms,
    why,
)

_FIRST = 256
"""Most replies are shorter; see :mod:`hilctl_drivers.transport.tcp`."""
_CHUNK, _UNSOLICITED = 4096, 65536
_QUIET_S = 0.02


def _counts_waiting(fd: int, waiting: "array.array[int]") -> Callable[[], object]:
    """Return a function that stores the number of received bytes in ``waiting[0]``."""
    # Only here: settings can be read and checked on computers that have neither.
    from fcntl import ioctl
    from termios import FIONREAD

    return partial(ioctl, fd, FIONREAD, waiting)


def _behind(request: bytes | bytearray, missing: Missing) -> Missing:
    """Return ``missing`` for replies after an echo of the request."""
    size = len(request)

    def counted(got: bytearray) -> int:
        if not request.startswith(got[:size]):
            raise CorruptError(
                "the reply does not begin with the request: omit echo if the adapter does not echo"
            )
        return max(0, size - len(got)) + missing(got[size:])

    return counted


class StreamLink(ABC):
    """A descriptor with one exchange at a time; subclasses open and close it.

    ``gap_s`` is the silence to keep between a reply and the next request. With ``echo`` each
    request comes back before its reply.
    """

    LOST = ""
    """Text on a broken connection."""

    def __init__(
        self,
        gap_s: float,
        timeout_s: float,
        clock: Callable[[], float] = time.monotonic,
        sleep: Callable[[float], None] = time.sleep,
        *,
        echo: bool = False,
    ) -> None:
        self._gap_s = gap_s
        self._echo = echo
        self.set_timeout(timeout_s)
        self._clock = clock
        self._sleep = sleep
        self._fd = -1
        self._poll = select.poll()
        self._waiting = array.array("i", [0])
        self._count_waiting: Callable[[], object] = lambda: None
        self._stale = True
        self._quiet_at = self._deadline = 0.0
        self._begun: bytes | bytearray = b""
        self._looked_ns = 0
        self.boot_hint = ""
        """Why there may be no answer, or no good one; empty after the first one."""

    def set_timeout(self, timeout_s: float) -> None:
        """Set the longest time of one exchange, s."""
        self.timeout_s = timeout_s
        self._timeout_ms = math.ceil(timeout_s * 1e3)

    @property
    def is_open(self) -> bool:
        """Whether it is open, as far as is known."""
        return self._fd >= 0

    @property
    def is_in_step(self) -> bool:
        """Whether it is open, and no bytes of an older exchange can still come."""
        return self.is_open and not self._stale

    @abstractmethod
    def open(self, *, boot: bool = True) -> None:
        """Connect, see :meth:`~hilctl_drivers.transport.links.Link.open`.

        Received bytes are discarded.

        Args:
            boot: Whether to wait for a device that opening may have reset. Otherwise a link that
                this object closed in step is in step.
        """

    def _use(self, fd: int) -> None:
        """Take an open descriptor, which must not block."""
        self._fd = fd
        self._count_waiting = _counts_waiting(fd, self._waiting)
        self._poll = select.poll()
        self._poll.register(fd, select.POLLIN)
        self._looked_ns = time.monotonic_ns()
        self._begun = b""

    def transact(
        self, request: bytes | bytearray, missing: Missing, usual: int = 0
    ) -> bytes | bytearray:
        """Exchange, see :meth:`~hilctl_drivers.transport.links.Link.transact`.

        After a failure the next request waits until the line is quiet and discards received bytes.
        """
        if self._fd < 0:
            raise LostError("not open")
        if self._echo:
            missing, usual = _behind(request, missing), 0
        reply: bytes | bytearray
        try:
            if self._begun != request:
                self._stale |= bool(self._begun)
                whole = self._put(request)
            else:
                whole = False
            self._begun = b""
            # Otherwise a part of the time-out has passed.
            if whole and usual and self._poll.poll(self._timeout_ms):
                reply = read(self._fd, _FIRST)
                if len(reply) != usual:
                    reply = self._complete(request, bytearray(reply), missing)
            else:
                reply = self._complete(request, bytearray(), missing)
        except (OSError, DeviceError) as error:
            raise self._failed(error) from None
        self.boot_hint = "" if reply else self.boot_hint
        if self._gap_s:
            self._quiet_at = self._clock() + self._gap_s
        return reply[len(request) :] if self._echo else reply

    def begin(self, request: bytes | bytearray) -> None:
        """Send the request of the next exchange; :meth:`transact` then awaits the reply to it."""
        if self._fd < 0:
            raise LostError("not open")
        try:
            self._put(request)
        except (OSError, DeviceError) as error:
            raise self._failed(error) from None
        self._begun = request

    def _put(self, request: bytes | bytearray) -> bool:
        """Send a request when the line is silent; return whether that took no time."""
        self._count_waiting()
        if self._waiting[0] or self._gap_s or self._stale:
            self._settle()
        self._deadline = self._clock() + self.timeout_s
        # Past pyserial, which takes three times as long; its flush() hangs on ptys and USB CDC.
        try:
            sent = write(self._fd, request)
        except BlockingIOError:
            sent = 0
        if sent < len(request):
            self._send(request[sent:])
        return sent == len(request)

    def wait(self, wait_s: float) -> bool:
        """Wait for unsolicited data; return whether any has arrived."""
        return bool(self._poll.poll(max(0.0, 1e3 * wait_s)))

    def receive(self) -> tuple[bytes, int]:
        """Return received unsolicited data, without waiting, and the longest age of its end in ns.

        The kernel does not report its arrival, so the age is the time since the last call.
        """
        if self._fd < 0:
            raise LostError("not open")
        looked_ns, self._looked_ns = self._looked_ns, time.monotonic_ns()
        try:
            self._count_waiting()
            data = self._read(_UNSOLICITED) if self._waiting[0] else b""
        except (OSError, DeviceError) as error:
            raise self._failed(error) from None
        return data, self._looked_ns - looked_ns

    def send_now(self, request: bytes | bytearray) -> None:
        """Send ``request`` regardless of bytes on the line, without waiting for a reply.

        The next exchange discards bytes received meanwhile.
        """
        if self._fd < 0:
            raise LostError("not open")
        self._stale = True
        try:
            self._send(request)
        except NoAnswerError:
            # Unsent bytes would be executed before the next attempt, or block it permanently.
            self._discard_unsent()
            raise
        except OSError as error:
            raise self._failed(error) from None

    def doubt(self) -> None:
        """Assume that bytes of an older exchange can still come, until the line was silent."""
        self._stale = True

    def _send(self, data: bytes | bytearray) -> None:
        """Send all, or raise NoAnswerError if that takes longer than the timeout."""
        deadline = self._clock() + self.timeout_s
        room = select.poll()
        room.register(self._fd, select.POLLOUT)
        late = False
        while data:
            if late or not room.poll(wait_ms(deadline, self._clock())):
                raise NoAnswerError(f"could not send within {self.timeout_s:g} s")
            late = self._clock() > deadline
            with suppress(BlockingIOError):
                data = data[write(self._fd, data) :]

    def _discard_unsent(self) -> None:  # noqa: B027  an unread TCP stream is closed soon
        """Discard bytes that wait to be sent."""

    def _failed(self, error: OSError | DeviceError) -> DeviceError:
        """Return the error to raise, and protect the next request from late bytes."""
        self._stale = True
        if isinstance(error, DeviceError):
            return error
        self.close()
        return LostError(f"{self.LOST} {why(error)}")

    def _settle(self) -> None:
        """Wait until the next request may be sent; raise DeviceError for unsolicited bytes."""
        if self._stale:
            self.drain()
            self._count_waiting()
        if self._waiting[0]:
            raise DeviceError(
                f"{self._waiting[0]} bytes that answer no request: another device sends, or the "
                "adapter echoes (then set echo: true)"
            )
        early_s = self._quiet_at - self._clock()
        if early_s > 0.0:
            self._sleep(early_s)

    def _complete(
        self, request: bytes | bytearray, reply: bytearray, missing: Missing
    ) -> bytearray:
        late, deadline = False, self._deadline
        while wanted := missing(reply):
            if late or not self._poll.poll(wait_ms(deadline, self._clock())):
                only_echo = reply.startswith(request) and not self._echo
                hint = f": {ECHOED}" if only_echo else self.boot_hint
                raise NoAnswerError(cut(len(reply), wanted, self.timeout_s) + hint)
            late = self._clock() > deadline
            reply += self._read()
        return reply

    def _read(self, size: int = _CHUNK) -> bytes:
        data = read(self._fd, size)
        if not data:
            self._nothing_read()
        return data

    @abstractmethod
    def _nothing_read(self) -> None:
        """Raise the error for a descriptor that was readable and had no bytes."""

    def await_silence(self, quiet_s: float, answer_s: float = 0.0) -> None:
        """Discard received bytes until the line was silent for ``quiet_s``.

        Before, wait up to ``answer_s`` for the first byte of an answer.
        """
        if self._fd < 0:
            raise LostError("not open")
        try:
            self._poll.poll(math.ceil(1e3 * answer_s))
            self.drain(quiet_s)
        except (OSError, DeviceError) as error:
            raise self._failed(error) from None

    def drain(self, quiet_s: float = _QUIET_S) -> None:
        """Discard received bytes until the line was silent for ``quiet_s``, or its own gap.

        Raises:
            OSError: The connection broke.
            DeviceError: The line did not get silent in time.
        """
        quiet_ms = math.ceil(1e3 * max(quiet_s, self._gap_s))
        deadline = self._clock() + max(self.timeout_s, 10.0 * _QUIET_S)
        while self._poll.poll(quiet_ms):
            self._read()
            if self._clock() > deadline:
                raise DeviceError("the line does not get quiet: another device keeps sending")
        self._stale = False

    @abstractmethod
    def close(self) -> None:
        """Close it; closing twice is fine."""
