"""A stage that is called by its address is the kernel itself, for every kernel that is one."""

import numpy as np
import pytest

from hilctl.kernels import dynamics, hysteresis, implicit, tick
from hilctl.kernels.jit import address, entry
from hilctl.kernels.limit import limit_block

ROWS = 6
WAVE = 3.0 * np.sin(np.arange(40) * 0.3)
PLAYS = [0.2, 0.5, 1.0]
WEIGHTS = [-0.1, -0.05, -0.02]
DEADBAND = 1.0, [0.5, 1.0], [0.1, 0.2], [-0.7], [0.3]  # slope, d_up, g_up, d_down, g_down
TABLE = [-4.0, 1.0, 8.0]
VALUES = np.linspace(-9.0, 9.0, 18)


def arrays(*given):
    return [np.array(each, dtype=np.float64) for each in given]


def numbers(*given):
    return np.concatenate([np.atleast_1d(np.array(each, dtype=np.float64)) for each in given])


STAGES = {
    "play_sum": (
        hysteresis.play_sum_stage,
        numbers(0.3, 0.9, PLAYS, WEIGHTS),
        4,
        lambda x, m, o: hysteresis.play_sum(x, 0.3, 0.9, *arrays(PLAYS, WEIGHTS), m, o),
    ),
    "stop_sum": (
        hysteresis.stop_sum_stage,
        numbers(0.9, PLAYS, WEIGHTS),
        4,
        lambda x, m, o: hysteresis.stop_sum(x, 0.9, *arrays(PLAYS, WEIGHTS), m, o),
    ),
    "integrated_inverse": (
        hysteresis.integrated_inverse_stage,
        numbers(DEADBAND[0], 0.3, 0.9, 2, 1, *DEADBAND[1:], PLAYS, WEIGHTS),
        4,
        lambda x, m, o: hysteresis.integrated_inverse(
            x, DEADBAND[0], *arrays(*DEADBAND[1:]), 0.3, 0.9, *arrays(PLAYS, WEIGHTS), m, o
        ),
    ),
    "implicit_inverse": (
        implicit.implicit_inverse_stage,
        numbers(implicit.PREISACH, -5.0, 5.0, 1e-7, 2, 18, [0.0, 0.5], VALUES, TABLE),
        3,
        lambda x, m, o: implicit.implicit_inverse(
            implicit.PREISACH, x, (-5.0, 5.0), 1e-7, tuple(arrays([0.0, 0.5], VALUES, TABLE)), m, o
        ),
    ),
    "lead": (
        dynamics.lead_stage,
        numbers(2.0, 0.1),
        2,
        lambda x, m, o: dynamics.lead_block(x, 2.0, 0.1, m, o),
    ),
    "between": (
        dynamics.between_stage,
        numbers(0.3),
        1,
        lambda x, m, o: dynamics.between_block(x, 0.3, m, o),
    ),
    "weigh": (
        dynamics.weigh_block,
        numbers(0.25, 0.5, 0.25),
        3,
        lambda x, m, o: dynamics.weigh_block(x, numbers(0.25, 0.5, 0.25), m, o),
    ),
    "offset": (dynamics.offset_stage, numbers(0.7), 0, lambda x, _m, o: np.add(x, 0.7, out=o)),
}


def rest(size):
    memory = np.zeros(size)
    memory[size - 1 :] = np.nan
    return memory


class Table:
    """One slot of 40 samples, a limiter that holds to +-2.5, and stages."""

    def __init__(self, stages=(), step=10.0):
        n = WAVE.size
        self.columns, self.flags = np.full((ROWS, n), np.nan), np.zeros(n, dtype=np.uint32)
        self.memory, self.exchange = rest(2), np.zeros((3, n))
        self.state = np.zeros(3)
        self.limits = np.array([0.25, -2.5, 2.5, step])
        self.stages = stages
        self.table = table = np.zeros(
            tick.FIRST_STAGE + tick.STAGE_NUMBERS * len(stages), dtype=np.int64
        )
        places = range(tick.REFERENCE_ROW, tick.REFERENCE_ROW + ROWS)
        table[places] = range(ROWS)
        sizes = {tick.BLOCK: n, tick.WIDTH: ROWS, tick.STATE_SIZE: 3, tick.STAGES: len(stages)}
        held = {
            tick.STATES: self.state,
            tick.COLUMNS: self.columns,
            tick.FLAGS: self.flags,
            tick.REFERENCE: WAVE,
            tick.INPUT: WAVE,
            tick.MEMORY: self.memory,
            tick.EXCHANGE: self.exchange,
            tick.LIMITS: self.limits,
        }
        bits = {tick.RANGE_BIT: 1, tick.SLEW_BIT: 2, tick.INVALID_BIT: 4}
        for place, number in (sizes | bits | {tick.LIMIT: address(limit_block)}).items():
            table[place] = number
        for place, each in held.items():
            table[place] = each.ctypes.data
        for i, (kernel, parameters, memory) in enumerate(stages):
            at = tick.FIRST_STAGE + tick.STAGE_NUMBERS * i
            table[at] = address(kernel)
            table[at + 1 : at + 3] = parameters.ctypes.data, parameters.size
            table[at + 3 : at + 5] = memory.ctypes.data, memory.size

    def row(self, place):
        return self.columns[self.table[place]]


@pytest.mark.parametrize("name", STAGES)
def test_a_stage_is_what_its_kernel_is(name):
    """The same bits, memory too, with its parameters packed and its output in its input's place."""
    kernel, parameters, size, plain = STAGES[name]
    wanted, memory = np.empty_like(WAVE), rest(size)
    plain(WAVE.copy(), memory, wanted)
    made = Table([(kernel, parameters, rest(size))])
    assert tick.plan_block(made.table, 0, 0) == -1
    assert made.row(tick.WANTED_ROW).tobytes() == wanted.tobytes()
    assert made.stages[0][2].tobytes() == memory.tobytes()
    assert not np.array_equal(wanted, WAVE)


def test_stages_follow_one_another():
    """Each gets what the one before it gives."""
    doubled = [(dynamics.offset_stage, numbers(0.5), np.empty(0))] * 2
    made = Table(doubled)
    tick.plan_block(made.table, 0, 0)
    assert made.row(tick.WANTED_ROW).tolist() == (WAVE + 0.5 + 0.5).tolist()


def test_what_a_block_holds_before_its_exchange():
    """State before the block, limited commands, and nothing answered yet."""
    made = Table()
    made.memory[:] = 7.0, 8.0
    assert tick.plan_block(made.table, 0, 0) == -1
    command = made.row(tick.COMMAND_ROW)
    assert made.state.tolist() == [7.0, 8.0, 0.25]
    assert command.tolist() == np.clip(WAVE, -2.5, 2.5).tolist()
    assert (made.flags == (np.abs(WAVE) > 2.5)).all()
    assert made.exchange[0].tolist() == command.tolist()
    assert np.isnan(made.exchange[1:]).all()
    assert made.limits[tick.LAST] == command[-1]


def test_first_wish_that_is_none():
    """Its index is returned, and the last command held."""
    made = Table()
    made.row(tick.INPUT_ROW)[:] = 1.0
    made.row(tick.INPUT_ROW)[5:] = np.nan
    assert tick.follow_block(made.table, 0) == 5
    assert made.row(tick.COMMAND_ROW).tolist() == [1.0] * WAVE.size
    assert made.flags.tolist() == [0] * 5 + [4] * (WAVE.size - 5)


def test_an_entry_is_the_kernel():
    """Called without a look at the types, it gives the same."""
    made = Table(step=0.1)
    assert entry(tick.plan_block)(made.table, 0, 0) == -1
    by_kernel = Table(step=0.1)
    tick.plan_block(by_kernel.table, 0, 0)
    assert made.columns.tobytes() == by_kernel.columns.tobytes()
    assert made.flags.any()
