"""Messages of a board: their sizes, as the firmware's own structs have them."""

import pytest

from hilctl_drivers.board import frames
from hilctl_drivers.board.frames import exchange_sizes

SIZES = {
    "EXCHANGE_REQUEST": 4, "EXCHANGE_REPLY": 5, "STREAM_REQUEST": 8, "STREAM_REPLY": 9,
    "FIFO_TAIL": 4, "WATCHDOG_REQUEST": 6, "WATCHDOG_REPLY": 7, "STATUS_REPLY": 3,
    "INFO_REPLY": 20, "CLOCK_REQUEST": 8, "CLOCK_REPLY": 7,
}  # fmt: skip
"""Bytes, from the table of protocol 1 in drivers/README.md: packed, least significant first."""


def test_structs_are_packed():
    """A struct with padding would be longer than the board's."""
    assert {name: getattr(frames, name).size for name in SIZES} == SIZES


def test_replies_differ_from_requests():
    names = ("EXCHANGE", "STREAM", "WATCHDOG", "SAFE", "INFO", "CLOCK")
    kinds = {getattr(frames, name) for name in names}
    assert len(kinds) == 6
    assert not any(kind & frames.REPLY_BIT for kind in kinds)


@pytest.mark.parametrize(
    ("samples", "size", "stream", "expected"),
    [(1, 4, False, (8, 13)), (1, 2, False, (6, 11)), (100, 4, True, (408, 413))],
)
def test_sizes_of_an_exchange(samples, size, stream, expected):
    """Head, values, and in the reply the tail of the queue."""
    assert exchange_sizes(samples, size, stream=stream) == expected
