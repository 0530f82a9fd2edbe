"""Messages of a board: their sizes, as the firmware's own structs have them.

``test_board_session.py`` and ``emulator/test_board_device.py`` check their bytes.
"""

import pytest

from hilctl_drivers.board.frames import exchange_sizes, watchdog_sizes


@pytest.mark.parametrize(
    ("samples", "size", "stream", "expected"),
    [(1, 4, False, (8, 13)), (1, 2, False, (6, 11)), (100, 4, True, (408, 413))],
)
def test_sizes_of_an_exchange(samples, size, stream, expected):
    assert exchange_sizes(samples, size, stream=stream) == expected


def test_sizes_of_a_watchdog_message():
    assert watchdog_sizes(4) == (10, 7)
