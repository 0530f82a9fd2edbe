"""How large a window of a reference is."""

import pytest

from hilctl.loop.window import window_size


@pytest.mark.parametrize(
    ("block", "rate_hz", "size"), [(1, 1000.0, 262_144), (50, 50e3, 262_150), (200, 2e5, 800_000)]
)
def test_whole_blocks_and_some_seconds(block, rate_hz, size):
    assert window_size(block, rate_hz) == size
    assert size % block == 0
    assert size / rate_hz >= 4.0
