"""Messages of a microcontroller board with a DAC and an ADC, version 2.

Each message is the payload of one binary frame, least significant byte first throughout::

    byte 0  type   byte 1  seq, counted up by the host and repeated in the reply   then the body

    EXCHANGE  10  n u16, n values          outputs one sample, n = 1, and samples the input
           -> 90  status u8, n u16, n values, fifo_level u16, underruns u16
    STREAM    11  first u32, n u16, n values     queues samples first .. first + n - 1
           -> 91  status u8, first u32, n u16, n values, fifo_level u16, underruns u16
    WATCHDOG  12  timeout_ms u32 (0: off), safe value   clears a trip, too
           -> 92  status u8, timeout_ms u32
    SAFE      13  value                    outputs it immediately, drops queued samples
           -> 93  status u8
    INFO      14  (nothing)
           -> 94  status u8, version u8, fifo_depth u16, block_max u16, rate_max_hz f32,
                  min f32, max f32, name in ASCII
    CLOCK     15  rate_hz f32 (0: stop), prefill u16    empties the queue, counts samples from 0
           -> 95  status u8, rate_hz f32 as really set
    STATE     16  (nothing)                changes nothing; boards of version 1 do not know it
           -> 96  status u8, flags u8, value as it is output, reading

A value is a float32 in volts unless the profile's channel has another type. The board samples its
input when it outputs a command, so ``first`` of a STREAM reply numbers the command that each
reading belongs to; a reply carries all readings since the last one. The sample clock starts when
``prefill`` samples are queued. When the FIFO is empty, the board holds the last value, and
counts that in ``underruns``. A refused message changes nothing.

A STREAM reply is held back until sample ``queued - prefill - 1`` is out, with ``queued`` the
samples taken since CLOCK, this message included, and carries the readings up to that sample.
Sample j is output (j + 1 + underruns) periods after the clock's start. The reply is sent
immediately while ``queued <= prefill``, if that moment has passed, or if the status is not 0. A
newer message cancels a delayed reply; if the watchdog trips meanwhile, its status is TRIPPED.
"""

from enum import IntFlag
from struct import Struct
from typing import Final

VERSIONS: Final = (1, 2)
"""Supported versions; STATE requires version 2."""
REPLY_BIT: Final = 0x80
"""Set in a reply's type."""

EXCHANGE: Final = 0x10
STREAM: Final = 0x11
WATCHDOG: Final = 0x12
SAFE: Final = 0x13
INFO: Final = 0x14
CLOCK: Final = 0x15
STATE: Final = 0x16

HEAD = Struct("<BB")
"""Of a request: type, seq. Its fields follow, then its values."""
REPLY_HEAD = Struct("<BBB")
"""Of a reply: type, seq, status. It ends there if the request was refused."""

EXCHANGE_FIELDS = Struct("<H")
"""n, in request and reply; after the values of a reply follows :data:`FIFO_TAIL`."""
STREAM_FIELDS = Struct("<IH")
"""first, n, in request and reply; after the values of a reply follows :data:`FIFO_TAIL`."""
FIFO_TAIL = Struct("<HH")
"""fifo_level, underruns."""
WATCHDOG_FIELDS = Struct("<I")
"""timeout_ms, in request and reply; the safe value follows in a request."""
INFO_REPLY = Struct("<BHHfff")
"""version, fifo_depth, block_max, rate_max_hz, min, max; the name follows."""
CLOCK_REQUEST = Struct("<fH")
"""rate_hz, prefill."""
CLOCK_REPLY = Struct("<f")
"""rate_hz."""
STATE_REPLY = Struct("<B")
""":class:`StateFlag`; the output's value and a reading follow."""


class Status(IntFlag):
    """The status byte of a reply."""

    TRIPPED = 0x01
    """The watchdog has tripped: the output is at its safe value, values are refused."""
    OUT_OF_RANGE = 0x02
    """Refused: a value is out of range or not a number."""
    BAD_MESSAGE = 0x04
    """Refused: unknown type, wrong length, or not in this state."""
    FIFO_FULL = 0x08
    """Refused: more samples than the FIFO has room for."""
    WRONG_FIRST = 0x10
    """Refused: ``first`` is not the next sample; a block was lost or duplicated."""


class StateFlag(IntFlag):
    """The flags of a reply to STATE."""

    TRIPPED = 0x01
    """The watchdog has tripped, and was not cleared since."""


def exchange_sizes(samples: int, value_bytes: int, *, stream: bool) -> tuple[int, int]:
    """Return payload bytes of an EXCHANGE or STREAM request and of its reply."""
    body = (STREAM_FIELDS if stream else EXCHANGE_FIELDS).size + samples * value_bytes
    return HEAD.size + body, REPLY_HEAD.size + body + FIFO_TAIL.size


def state_sizes(values_bytes: int) -> tuple[int, int]:
    """Return payload bytes of a STATE request and of its reply with both values."""
    return HEAD.size, REPLY_HEAD.size + STATE_REPLY.size + values_bytes


def watchdog_sizes(value_bytes: int) -> tuple[int, int]:
    """Return payload bytes of a WATCHDOG request and of its reply."""
    return HEAD.size + WATCHDOG_FIELDS.size + value_bytes, REPLY_HEAD.size + WATCHDOG_FIELDS.size
