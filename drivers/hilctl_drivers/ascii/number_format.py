"""Formats of the numbers in lines and frames: how they are sent, recognised and read.

A field ``{value:FORMAT}`` of a template or of a pattern has one of these formats:

- the Python format of a decimal number, such as ``+07.3f``; a comma at its end, as in ``.3f,``, is
  for a decimal comma;
- ``X`` or ``04X``: a whole number from 0 in hexadecimal, of any length or of 4 digits;
- a type of :mod:`hilctl_drivers.modbus.register_map`, with an order if needed, such as
  ``int32 DCBA``: the bytes of the number in hexadecimal, separated by blanks, as in frames; with X,
  as in ``int16X``, without blanks, as in lines.

SCPI-1999 volume 1, 7.2.1; the decimal forms are those of IEEE 488.2, 8.7.
"""

import re
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, partial
from typing import cast, get_args

from hilctl_drivers.modbus.register_map import RegisterFormat, RegisterType
from hilctl_drivers.transport.links import BadRequestError, CorruptError

_BYTES = re.compile(rf"({'|'.join(get_args(RegisterType))})(X?)(?: ([A-H]+))?")
_HEXADECIMAL = re.compile(r"(0[1-9])?[Xx]")
_NUMBER = r"[+-]? *(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d{1,4})?"
_SCPI_INFINITY = 9.9e37
"""SCPI-1999 uses this for infinity, and 9.91e37 for NaN."""


@dataclass(frozen=True, slots=True)
class NumberFormat:
    """A format; ``text`` raises BadRequestError, and ``number`` raises CorruptError."""

    text: Callable[[float], str]
    number: Callable[[str], float]
    """NaN if the device sent it."""
    regex: str
    mark: str = ""
    """Decimal mark; empty if the number is not decimal."""


def as_text(data: bytes) -> str:
    """Return bytes as they are written in profiles."""
    return data.hex(" ").upper()


@cache
def number_format(spec: str) -> NumberFormat:
    """Return a format; raise ValueError if there is no such format."""
    if found := _BYTES.fullmatch(spec):
        form = RegisterFormat(cast("RegisterType", found[1]), found[3] or "")
        gap = "" if found[2] else " "
        return NumberFormat(
            lambda number: as_text(form.encode(number)).replace(" ", gap),
            lambda text: form.decode(bytes.fromhex(text)),
            rf"[0-9A-F]{{2}}(?:{gap}[0-9A-F]{{2}}){{{form.size - 1}}}",
        )
    if _HEXADECIMAL.fullmatch(spec):
        digits = f"{{{spec[1]}}}" if len(spec) > 1 else "+"
        hexadecimal = partial(int, base=16)
        return NumberFormat(partial(_hexadecimal, spec), hexadecimal, f"[0-9A-Fa-f]{digits}")
    mark = "," if spec.endswith(",") else "."
    plain = spec.removesuffix(",")
    whole = plain.endswith("d")
    try:
        format(0 if whole else 0.0, plain)
    except ValueError:
        rule = f"fields must have the format of a number, got {spec!r}"
        raise ValueError(f"{rule}: use one such as .4f, 04X, int16 or int32 DCBA") from None
    return NumberFormat(
        lambda number: format(round(number) if whole else number, plain).replace(".", mark),
        partial(parse_number, mark=mark),
        f" *{_NUMBER}".replace(r"\.", mark if mark == "," else r"\."),
        mark,
    )


def _hexadecimal(spec: str, number: float) -> str:
    """Return a whole number in hexadecimal; raise BadRequestError if it does not fit."""
    text = format(round(number), spec)
    if number < -0.5 or (len(spec) > 1 and len(text) > int(spec[1])):
        most = f"0x{'F' * int(spec[1])}" if len(spec) > 1 else "any number"
        raise BadRequestError(f"{spec} holds 0 to {most}, got {number:g}")
    return text


def parse_number(text: str, mark: str = ".") -> float:
    """Return the number in a text that is exactly one decimal number; blanks are allowed around it.

    Blanks may follow its sign. ``mark`` is its decimal mark.

    Raises:
        CorruptError: Anything else, or the SCPI values for infinity and NaN.
    """
    body = text.strip(" ")
    if mark != ".":
        body = body.replace(".", "!").replace(mark, ".")
    if not re.fullmatch(_NUMBER, body, re.ASCII):
        raise CorruptError(f"must be one number, got {text!r}")
    value = float(body.replace(" ", ""))
    if abs(value) >= _SCPI_INFINITY:
        rule = "if it is a reading, set invalid of its input in the profile"
        raise CorruptError(f"means no measurement: {text!r}; {rule}")
    return value
