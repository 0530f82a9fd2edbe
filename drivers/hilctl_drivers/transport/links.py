"""Link contract (one request, one reply, within the timeout) and the errors of a link.

Nothing is pipelined and nothing is sent twice. The caller computes from the bytes so far where a
reply ends; pauses between bytes mean nothing. Texts of errors do not name the device or the action:
the device that owns the link adds them.

DeviceError
|-- NoAnswerError     no complete reply in time
|-- LostError         the connection is gone
`-- FrameError        any of the below
    |-- BadRequest    the request cannot be put on this wire; nothing was sent
    |-- Incomplete    a good beginning, but more bytes are needed
    |-- Corrupt       a check or the structure is wrong
    |-- Mismatch      well formed, but not the answer to this request
    `-- Refused       the device understood the request and refused it
        `-- WatchdogTripped   its host watchdog has put the output at its safe value
"""

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from types import MappingProxyType
from typing import Protocol, TypeAlias

from hilctl.base.errors import DeviceError
from hilctl.base.files import reason

Missing: TypeAlias = Callable[[bytearray], int]
"""How many more bytes to wait for, at least, after those that have come; 0 if the reply is
there. It may raise where they cannot be the beginning of one."""


class NoAnswerError(DeviceError):
    """Nothing, or not all of a reply, came in time."""


class LostError(DeviceError):
    """The connection is gone: refused, reset, closed by the peer, or unplugged."""


class Link(Protocol):
    """A way to send a request and get its reply."""

    @property
    def name(self) -> str:
        """Where it leads, for messages: ``host:port`` or the serial port."""
        ...

    def open(self) -> None:
        """Connect.

        Raises:
            LostError: No device answers, or the port is in use.
        """
        ...

    def transact(
        self, request: bytes | bytearray, missing: Missing, usual: int = 0
    ) -> bytes | bytearray:
        """Send ``request`` and return the whole reply.

        Args:
            request: What to send.
            missing: Says how much of the reply is still to come.
            usual: Size of a good reply, where it is known: ``missing`` is not asked then when just
                that much has come.

        Raises:
            NoAnswerError: The reply was not complete in time.
            LostError: The link is not open, or broke.
            DeviceError: Bytes came that are no reply.
        """
        ...

    def close(self) -> None:
        """Close the link; closing twice is fine."""
        ...


@contextmanager
def naming(who: str) -> Iterator[None]:
    """Prefix errors with the name of a device; an empty name changes nothing."""
    try:
        yield
    except DeviceError as error:
        if who:
            raise DeviceError(f"{who}: {error}") from None
        raise


def why(error: OSError, remedies: Mapping[int, str] = MappingProxyType({})) -> str:
    """Return the text of an OS error, for use in a sentence, with a suggested fix.

    Args:
        error: What was raised.
        remedies: What to do, by ``errno``.
    """
    text = reason(error, remedies)
    return text[:1].lower() + text[1:]


def cut(got: int, wanted: int, timeout_s: float) -> str:
    """Return what is wrong with a reply that was not complete in time.

    Args:
        got: Bytes that have come.
        wanted: Bytes that were still waited for.
        timeout_s: Timeout of the exchange, s.
    """
    what = f"only {got} bytes, {wanted} short," if got else "no answer"
    return f"{what} within {timeout_s:g} s"


class FrameError(DeviceError):
    """A message cannot be built, or what came back is not a good answer to it."""


class BadRequestError(FrameError, ValueError):
    """What is asked cannot be put on this wire; nothing was sent.

    Example scenarios: more registers than a frame holds, a value that the register's type or the
    number's field can't hold. Also a ``ValueError``, so that a profile's validation can collect it.
    """


class IncompleteError(FrameError):
    """The bytes so far are the beginning of a message: read on until the deadline."""


class CorruptError(FrameError):
    """The bytes are not a message: a check or the structure is wrong."""


class MismatchError(FrameError):
    """A well-formed message, but not the answer to what was asked.

    Example scenarios: another transaction, unit, function, address or length; a late answer to an
    earlier request.
    """


class RefusedError(FrameError):
    """The device understood the request and refused it.

    Attributes:
        code: Modbus exception code, SCPI error number or the device's own mark, such as ``E01``.
    """

    def __init__(self, text: str, code: int | str = "") -> None:
        super().__init__(text)
        self.code = code


class WatchdogTrippedError(RefusedError):
    """The host watchdog has tripped: the output is at its safe value, commands are ignored."""
