"""The newest samples of a run."""

import numpy as np
import pytest

from hilctl.base.samples import Batch, Head
from hilctl.run.tail import Tail


def batch(first, blocks, block):
    made = Batch.empty(blocks, block, 1)
    made.heads[:, Head.FIRST_SAMPLE] = first + block * np.arange(blocks)
    numbers = first + np.arange(blocks * block).reshape(blocks, block)
    made.columns[:] = numbers[:, None, :]
    made.flags[:] = numbers
    return made


@pytest.mark.parametrize("block", [1, 7, 4000])
def test_last_samples_come_up_to_the_one_asked_for(block):
    """However they came, the samples before an event are told in order, and no later ones."""
    tail = Tail(50)
    for start in range(0, 40 * block, 4 * block):
        tail.add(batch(start, 4, block))
    last = 40 * block - 1
    for sample in (last, last - min(3, last)):
        found = tail.up_to(sample)
        first = max(0, sample - 49)
        assert found.index.tolist() == list(range(first, sample + 1))
        assert found.command.tolist() == found.index.tolist()
        assert found.flags.tolist() == found.index.tolist()


def test_nothing_comes_before_the_first_sample():
    """An event before any sample has none to tell."""
    tail = Tail(50)
    assert tail.up_to(10) is None
    tail.add(batch(100, 1, 5))
    assert tail.up_to(99) is None
    assert tail.up_to(102).index.tolist() == [100, 101, 102]
