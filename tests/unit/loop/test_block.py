"""A block is views of one slot: values written to it are in the arrays of the slot."""

from hilctl.base.samples import COLUMNS, BlockBatch
from hilctl.loop.block import Block

BLOCK_NAMES = {"reference_um": "reference"}  # in the command's unit where nothing compensates


def test_each_name_is_the_column_of_that_name():
    area = BlockBatch.empty(3, 5, 4)
    block, columns = Block(area.heads[1].data, area, 1), area.columns[1]
    for number, name in enumerate(COLUMNS, start=1):
        getattr(block, BLOCK_NAMES.get(name, name))[:] = number
    assert columns[:, 2].tolist() == list(range(1, len(COLUMNS) + 1))


def test_memory_is_the_state_without_the_command_before():
    area = BlockBatch.empty(3, 1, 4)
    block = Block(area.heads[1].data, area, 1)
    block.memory[:] = 1.0
    assert area.states[1].tolist() == [1.0, 1.0, 1.0, 0.0]
    assert (block.due, block.guarded, block.number, block.skipped) == (True, True, 0, 0)
