"""What reading a file may take, by its size."""

import pytest

from hilctl.base.errors import DataError
from hilctl.recording.read_budget import ReadBudget


@pytest.mark.parametrize("count", ["read", "expand", "keep"])
def test_bytes_are_bounded_by_the_size(count):
    budget = ReadBudget(10**6)
    getattr(budget, count)(50 * 10**6)
    with pytest.raises(DataError, match="than a recording of its size can"):
        getattr(budget, count)(200 * 10**6)


def test_messages_are_bounded_by_the_size():
    budget = ReadBudget(16 * 1000)
    for _ in range(101_000):
        budget.message()
    with pytest.raises(DataError, match="more messages"):
        budget.message()


def test_each_is_counted_by_itself():
    budget = ReadBudget(0)
    for count in (budget.read, budget.expand, budget.keep):
        count(64 * 2**20)
