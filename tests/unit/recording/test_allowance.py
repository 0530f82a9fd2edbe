"""What reading a file may take, by its size."""

import pytest

from hilctl.base.errors import DataError
from hilctl.recording.allowance import Allowance


@pytest.mark.parametrize("count", ["read", "expand", "keep"])
def test_bytes_are_bounded_by_the_size(count):
    allowance = Allowance(10**6)
    getattr(allowance, count)(50 * 10**6)
    with pytest.raises(DataError, match="than a recording of its size can"):
        getattr(allowance, count)(200 * 10**6)


def test_messages_are_bounded_by_the_size():
    allowance = Allowance(16 * 1000)
    for _ in range(101_000):
        allowance.message()
    with pytest.raises(DataError, match="more messages"):
        allowance.message()


def test_each_is_counted_by_itself():
    allowance = Allowance(0)
    for count in (allowance.read, allowance.expand, allowance.keep):
        count(64 * 2**20)
