"""Link contract (one request, one reply, within the timeout) and the errors of a link.

Nothing is pipelined and nothing is sent twice. The caller computes the end of a reply from its
bytes, not from pauses. Errors do not name the device or the action: the device adds them.

DeviceError
|-- NoAnswerError     no complete reply in time
|-- LostError         the connection is gone
`-- FrameError        any of the below
    |-- BadRequestError    the request cannot be sent on this link; nothing was sent
    |-- IncompleteError    a good beginning, but more bytes are needed
    |-- CorruptError       a check or the structure is wrong
    |-- MismatchError      well formed, but not the answer to this request
    `-- RefusedError       the device understood the request and refused it
        `-- WatchdogTrippedError   its host watchdog has put the output at its safe value
"""

import math
from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Protocol, TypeAlias

from hilctl.base.errors import DeviceError
from hilctl.base.files import reason

Missing: TypeAlias = Callable[[bytearray], int]
"""Least number of bytes missing after the received ones; 0 if the reply is complete. It may raise
if they cannot be the start of a reply."""

ECHOED = (
    "the request came back before the reply: the adapter echoes, or receives what it sends; "
    "set echo: true beside the address"
)
"""Message for a request that is received in place of its reply."""


class NoAnswerError(DeviceError):
    """No complete reply came in time."""


class LostError(DeviceError):
    """The connection is gone: refused, reset, closed by the peer, or unplugged."""


class Link(Protocol):
    """A connection to a device."""

    @property
    def is_open(self) -> bool:
        """Whether it is open, as far as is known."""

    def open(self) -> None:
        """Connect; raise LostError if no device answers, or the port is in use."""

    def transact(
        self, request: bytes | bytearray, missing: Missing, usual: int = 0
    ) -> bytes | bytearray:
        """Send ``request`` and return the whole reply.

        Args:
            request: The bytes to send.
            missing: Returns how much of the reply is missing.
            usual: Size of a good reply, or 0: a reply of this size is complete.

        Raises:
            NoAnswerError: The reply was not complete in time.
            LostError: The link is not open, or broke.
            DeviceError: The bytes received are no reply.
        """

    def doubt(self) -> None:
        """Note a failure: late effects of an older request must not affect the next one."""

    def close(self) -> None:
        """Close the link; closing twice is fine."""


class ErrorPrefix:
    """A context that prefixes errors with the name of a device; an empty name changes nothing."""

    def __init__(self, who: str) -> None:
        self._who = who

    def __enter__(self) -> None:
        """Enter it."""

    def __exit__(self, _kind: object, error: BaseException | None, _trace: object) -> None:
        """Replace a DeviceError by one with the name."""
        if self._who and isinstance(error, DeviceError):
            raise DeviceError(f"{self._who}: {error}") from None


def why(error: OSError, remedies: Mapping[int, str] = MappingProxyType({})) -> str:
    """Return the text of an OS error, for use in a sentence, with the remedy for its ``errno``."""
    text = reason(error, remedies)
    return text[:1].lower() + text[1:]


def wait_ms(deadline: float, now: float) -> int:
    """Return the longest wait for the rest of a reply, in ms: 0 after the deadline.

    A link then still reads received bytes once, because the host may have stalled meanwhile.
    """
    return max(0, math.ceil((deadline - now) * 1e3))


def cut(got: int, wanted: int, timeout_s: float) -> str:
    """Return the text on an incomplete reply, from the numbers of bytes received and missing."""
    what = f"only {got} bytes, {wanted} short," if got else "no answer"
    return f"{what} within {timeout_s:g} s"


class FrameError(DeviceError):
    """A message cannot be built, or its reply is invalid."""


class BadRequestError(FrameError, ValueError):
    """The request cannot be sent on this link, such as too many registers; nothing was sent.

    It is a ``ValueError`` too, so that a profile's validation can collect it.
    """


class IncompleteError(FrameError):
    """The bytes so far are the beginning of a message: read on until the deadline."""


class CorruptError(FrameError):
    """The bytes are not a message: a check or the structure is wrong."""


class MismatchError(FrameError):
    """A well-formed message, but not the answer to this request, such as a late answer."""


class RefusedError(FrameError):
    """The device understood the request and refused it.

    Attributes:
        code: Modbus exception code, SCPI error number or the device's own code, such as ``E01``.
    """

    def __init__(self, text: str, code: int | str = "") -> None:
        super().__init__(text)
        self.code = code


class WatchdogTrippedError(RefusedError):
    """The host watchdog has tripped: the output is at its safe value, commands are ignored."""
