"""Lines of text on a serial port: terminators, checksums, numbers and answers.

DCON (ICP DAS, Advantech ADAM): ICP DAS "DCON protocol command set" and "I-7021 User Manual" A.5 on
the host watchdog. GEN (TDK-Lambda): "Genesys User Manual" 7.5 and 7.6. SCPI: SCPI-1999 volume 1,
7.2.1 for numbers and volume 2, 21.8 for errors; number forms as in IEEE 488.2, 8.7.
"""

import math
import re
from dataclasses import dataclass
from typing import Literal, TypeAlias

from hilctl_drivers.wire.crc import Bytes, dcon_checksum, gen_checksum
from hilctl_drivers.wire.errors import (
    BadRequest,
    Corrupt,
    Incomplete,
    Mismatch,
    Refused,
    WatchdogTripped,
)
from hilctl_drivers.wire.splitters import DelimitedSplitter

ChecksumKind: TypeAlias = Literal["none", "dcon", "gen"]

SCPI_INFINITY = 9.9e37
"""SCPI-1999 sends this for infinity and 9.91e37 for not a number."""

_CHECKSUMS = {"none": lambda _text: b"", "dcon": dcon_checksum, "gen": gen_checksum}
_CHECKSUM_SIZES = {"none": 0, "dcon": 2, "gen": 3}
_NUMBER = re.compile(r"[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d{1,4})?", re.ASCII)
_SCPI_ERROR = re.compile(r'([+-]?\d{1,5}), ?"((?:[^"]|"")*)"', re.ASCII)
_GEN_ERROR = re.compile(r"[CE]\d\d", re.ASCII)
_GEN_ERRORS = {
    "C01": "illegal command or query",
    "C02": "missing parameter",
    "C03": "illegal parameter",
    "C04": "checksum error",
    "C05": "setting out of range",
    "E01": "voltage above the acceptable range",
    "E02": "voltage below the under-voltage limit",
    "E04": "over-voltage protection below the acceptable range",
    "E06": "under-voltage limit above the programmed voltage",
    "E07": "output can't be switched on during a fault shut-down",
}


def _is_text(text: str) -> bool:
    return text.isascii() and text.isprintable()


@dataclass(frozen=True)
class LineFormat:
    """How one line stands on the wire: ``text | checksum | terminator``.

    Attributes:
        terminator: Bytes that end a line: control characters.
        checksum: ``none``, ``dcon`` (two hex digits) or ``gen`` (``$`` and two hex digits).
        size_max: Most bytes of a line without its terminator.

    Raises:
        BadRequest: Unknown checksum, or a terminator that could be part of the text.
    """

    terminator: bytes = b"\r"
    checksum: ChecksumKind = "none"
    size_max: int = 255

    def __post_init__(self) -> None:
        if self.checksum not in _CHECKSUMS:
            known = ", ".join(_CHECKSUMS)
            raise BadRequest(f"unknown line checksum {self.checksum!r}; known are {known}")
        if not self.terminator or any(32 <= byte < 127 for byte in self.terminator):
            raise BadRequest(f"terminator must be control characters, got {self.terminator!r}")

    def encode(self, text: str) -> bytes:
        """Return a line.

        Raises:
            BadRequest: Empty, too long, or more than printable ASCII.
        """
        if not text or not _is_text(text):
            raise BadRequest(f"a line must be printable ASCII, got {text!r}")
        body = text.encode("ascii")
        body += _CHECKSUMS[self.checksum](body)
        if len(body) > self.size_max:
            raise BadRequest(f"a line has at most {self.size_max} bytes, got {len(body)}: {text!r}")
        return body + self.terminator

    def decode(self, line: Bytes) -> str:
        """Return the text of exactly one line.

        Raises:
            Incomplete: The terminator has not come yet.
            Corrupt: Wrong checksum, too long, more than printable ASCII, or bytes behind the end.
        """
        data = bytes(line)
        end = data.find(self.terminator)
        if end < 0 and len(data) < self.size_max + len(self.terminator):
            raise Incomplete(f"{data!r} without {self.terminator!r}")
        if end != len(data) - len(self.terminator):
            raise Corrupt(f"must be one line that ends in {self.terminator!r}, got {data!r}")
        return self._text(data[:end])

    def splitter(self) -> DelimitedSplitter[str]:
        """Return a splitter at the beginning of a stream of lines."""
        return DelimitedSplitter(self._text, self.terminator, self.size_max, skip_empty=False)

    def _text(self, part: Bytes) -> str:
        body = bytes(part)
        if len(body) > self.size_max:
            raise Corrupt(f"a line has at most {self.size_max} bytes, got {len(body)}")
        text = body.decode("latin-1")
        if not _is_text(text):
            raise Corrupt(f"a line must be printable ASCII, got {body!r}")
        split = max(0, len(body) - _CHECKSUM_SIZES[self.checksum])
        want = _CHECKSUMS[self.checksum](body[:split])
        if body[split:] != want:
            raise Corrupt(f"checksum of {text!r} must be {want.decode()}")
        return text[:split]


def fixed_number(value: float, integer_digits: int, decimals: int) -> str:
    """Return a number with its sign and a fixed count of digits, such as ``+05.000``.

    Raises:
        BadRequest: ``value`` is not finite or has more digits before the point.
    """
    width = 1 + integer_digits + (decimals + 1 if decimals else 0)
    text = f"{value:+0{width}.{decimals}f}"
    if not math.isfinite(value) or len(text) != width:
        field = "0" * integer_digits + ("." + "0" * decimals if decimals else "")
        raise BadRequest(f"{value} does not fit the field +{field}")
    if not text.strip("+-0."):
        return "+" + text[1:]
    return text


def tenths_hex(seconds: float) -> str:
    """Return a time as two hex digits of 0.1 s, as in ``~AA3EVV``: 10.0 s is ``64``.

    Raises:
        BadRequest: Not a whole number of tenths from 0.1 s to 25.5 s.
    """
    tenths = seconds * 10
    if not 0.5 < tenths < 255.5 or abs(tenths - round(tenths)) > 1e-6:
        raise BadRequest(f"must be 0.1 to 25.5 s in steps of 0.1 s, got {seconds}")
    return f"{round(tenths):02X}"


def parse_number(text: str) -> float:
    """Return the number in a text that is exactly one number; blanks around it are fine.

    Raises:
        Corrupt: Anything else, or SCPI's marks for infinity and not a number.
    """
    body = text.strip(" ")
    if not _NUMBER.fullmatch(body):
        raise Corrupt(f"must be one number, got {text!r}")
    value = float(body)
    if abs(value) >= SCPI_INFINITY:
        raise Corrupt(f"stands for no measurement: {text!r}")
    return value


def parse_fixed_number(text: str, integer_digits: int, decimals: int) -> float:
    """Return the number in a field of :func:`fixed_number`'s form.

    Raises:
        Corrupt: Another form, such as the ``+9999`` of an input that is out of range.
    """
    tail = rf"\.\d{{{decimals}}}" if decimals else ""
    if not re.fullmatch(rf"[+-]\d{{{integer_digits}}}{tail}", text, re.ASCII):
        raise Corrupt(f"must be a sign, {integer_digits} and {decimals} digits, got {text!r}")
    return float(text)


def dcon_answer(command: str, reply: str) -> str:
    """Check a DCON reply against its command and return the data in it.

    ``#`` is answered by ``>(data)``, the others by ``!AA(data)``. A bare ``!`` is something else:
    the command was ignored because the host watchdog has tripped.

    Args:
        command: As sent, without checksum and terminator.
        reply: As received, without them.

    Raises:
        WatchdogTripped: ``!``.
        Refused: ``?`` (out of range, the module then puts out the nearest end of its range) or
            ``?AA`` (invalid command); ``code`` is the reply.
        Mismatch: The answer of another module, or to another command.
    """
    if reply == "!":
        text = f"{command}: ignored, the host watchdog has tripped: output is at its safe value"
        raise WatchdogTripped(text, reply)
    if reply == "?":
        raise Refused(f"{command}: out of range, the output is at the end of its range", reply)
    address = command[1:3]
    # % changes the address: its answer comes from the old or the new one.
    addresses = {address, command[3:5]} if command[:1] == "%" else {address}
    if reply[:1] == "?" and reply[1:] in addresses:
        raise Refused(f"{command}: invalid command", reply)
    if reply[:1] == ">" and command[:1] in {"#", "@"}:
        return reply[1:]
    if reply[:1] == "!" and command[:1] != "#" and reply[1:3] in addresses:
        return reply[3:]
    raise Mismatch(f"{command}: not an answer to this: {reply!r}")


def gen_answer(reply: str) -> str:
    """Return a TDK-Lambda GEN reply (``OK`` or data) that is no error message.

    Raises:
        Refused: ``Cnn`` or ``Enn``; ``code`` is the reply.
    """
    if _GEN_ERROR.fullmatch(reply):
        raise Refused(f"{reply}: {_GEN_ERRORS.get(reply, 'not in the manual')}", reply)
    return reply


def scpi_error(reply: str) -> None:
    """Check an answer to ``SYST:ERR?``: ``0,"No error"`` passes.

    Raises:
        Refused: Any other error; ``code`` is its number.
        Corrupt: Not of the form ``number,"text"``.
    """
    match = _SCPI_ERROR.fullmatch(reply)
    if not match:
        raise Corrupt(f'must be number,"text", got {reply!r}')
    code = int(match[1])
    if code:
        raise Refused(f"error {code}: {match[2]}", code)
