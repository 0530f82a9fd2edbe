"""What can go wrong with one message on a wire.

DeviceError
`-- FrameError        any of the below
    |-- BadRequest    what is asked can't be put on this wire; nothing was sent
    |-- Incomplete    a good beginning, but more bytes are needed
    |-- Corrupt       a check or the structure is wrong
    |-- Mismatch      well formed, but not the answer to what was asked
    `-- Refused       the device understood and said no
        `-- WatchdogTripped   its host watchdog has put the output at its safe value

The texts say what was wrong with the bytes; devices put their own name and the deed in front.
"""

from hilctl.base.errors import DeviceError


class FrameError(DeviceError):
    """A message can't be built, or what came back is not a good answer to it."""


class BadRequest(FrameError, ValueError):  # noqa: N818  conditions of a protocol, caught by name
    """What is asked can't be put on this wire; nothing was sent.

    Example scenarios: more registers than a frame holds, a value that the register's type or the
    number's field can't hold. Also a ``ValueError``, so that a profile's validation can collect it.
    """


class Incomplete(FrameError):  # noqa: N818
    """The bytes so far are the beginning of a message: read on until the deadline."""


class Corrupt(FrameError):  # noqa: N818
    """The bytes are not a message: a check or the structure is wrong."""


class Mismatch(FrameError):  # noqa: N818
    """A well-formed message, but not the answer to what was asked.

    Example scenarios: another transaction, unit, function, address or length; a late answer to an
    earlier request.
    """


class Refused(FrameError):  # noqa: N818
    """The device understood the request and refused it.

    Attributes:
        code: Modbus exception code, SCPI error number or the device's own mark, such as ``E01``.
    """

    def __init__(self, text: str, code: int | str = "") -> None:
        super().__init__(text)
        self.code = code


class WatchdogTripped(Refused):
    """The host watchdog has tripped: the output is at its safe value, commands are ignored."""
