"""The arithmetic of a tick, composed of the kernels that a run has: two calls a tick.

What is composed stands in a table of whole numbers: addresses of arrays and of kernels, sizes, and
rows of a block's columns. The kernels are called by their addresses, so the machine code that runs
here is the same that the rest of the loop, the replay and the tests call, and a change of one in
its own file does not leave an old copy of it in this one's cache.

Only :mod:`hilctl.loop.composed` makes tables.
"""

from collections.abc import Callable
from typing import Any, TypeAlias, cast

import numpy as np
from llvmlite import ir
from numba import types
from numba.core.typing.templates import Signature
from numba.extending import intrinsic
from numba.np.numpy_support import carray

from hilctl.base.arrays import F64, I64, U32
from hilctl.kernels.jit import kernel

(
    BLOCK,
    WIDTH,
    STATE_SIZE,
    STATES,
    COLUMNS,
    FLAGS,
    REFERENCE_ROW,
    WANTED_ROW,
    COMMAND_ROW,
    DISPLACEMENT_ROW,
    MEASURED_ROW,
    INPUT_ROW,
    REFERENCE,
    REFERENCE_SIZE,
    INPUT,
    MEMORY,
    EXCHANGE,
    LIMIT,
    LIMITS,
    RANGE_BIT,
    SLEW_BIT,
    INVALID_BIT,
    INTERLOCK,
    SETTINGS,
    SETTINGS_SIZE,
    INTERLOCK_MEMORY,
    INTERLOCK_MEMORY_SIZE,
    STAGES,
    FIRST_STAGE,
) = range(29)
STAGE_NUMBERS = 5
"""Numbers of each stage, from ``FIRST_STAGE`` on: kernel, parameters and size, memory and size."""

(
    NUMBERS,
    FIELDS,
    HEADS,
    HEAD_NUMBERS,
    SLOTS,
    SILENCE_NS,
    HEARTBEAT,
    NEXT_SAMPLE,
    LATE_TICKS,
    STOP,
    SUPERVISOR_HEARTBEAT,
    TUNE_WANTED,
    TUNE_TAKEN,
    SENT,
    ANSWERED,
    TAIL,
    ENDED_AT,
    EXCHANGING,
    HEAD_SEQUENCE,
    HEAD_FIRST_SAMPLE,
    HEAD_SAMPLES,
    HEAD_DROPPED_BEFORE,
    HEAD_DEADLINE_NS,
    HEAD_LATE_NS,
    HEAD_EXCHANGE_NS,
) = range(25)
HOST_NUMBERS = 25
"""Numbers of a host: addresses and sizes of its page and its heads, and which number is which."""

ASKED = -2
"""What :func:`begin_tick` returns where the tick is not a usual one."""

LAST, LOW, HIGH, STEP = range(4)
"""Places of the limiter's numbers: last command, range, largest step."""
LIMITER_NUMBERS = 4

_F64S = types.Array(types.float64, 1, "C")
_U32S = types.Array(types.uint32, 1, "C")
_Typed: TypeAlias = tuple[Any, Callable[..., Any]]


def _by_address(returns: Any, *takes: Any) -> _Typed:
    """Return how numba types and makes a call of a kernel of this signature by its address."""

    def generate(context: Any, builder: Any, typed: Any, values: Any) -> Any:
        kinds = [context.get_value_type(each) for each in takes]
        function = ir.FunctionType(context.get_value_type(returns), kinds)
        called = builder.call(builder.inttoptr(values[0], function.as_pointer()), values[1:])
        return called if returns is not types.void else context.get_dummy_value()

    return Signature(returns, (types.int64, *takes), None), generate


def _stage(_context: Any, _address: Any, _x: Any, _p: Any, _memory: Any, _out: Any) -> _Typed:
    return _by_address(types.void, _F64S, _F64S, _F64S, _F64S)


def _limit(
    _context: Any,
    _address: Any,
    _wanted: Any,
    _previous: Any,
    _low: Any,
    _high: Any,
    _step: Any,
    _range_bit: Any,
    _slew_bit: Any,
    _invalid_bit: Any,
    _command: Any,
    _flags: Any,
) -> _Typed:
    numbers, bits = (types.float64,) * 4, (types.uint32,) * 3
    return _by_address(types.int64, _F64S, *numbers, *bits, _F64S, _U32S)


def _interlock(
    _context: Any,
    _address: Any,
    _settings: Any,
    _memory: Any,
    _command: Any,
    _reference: Any,
    _displacement: Any,
    _measured: Any,
    _flags: Any,
) -> _Typed:
    return _by_address(types.int64, _F64S, _F64S, _F64S, _F64S, _F64S, _F64S, _U32S)


def _pointer(_context: Any, _address: Any) -> _Typed:
    def generate(context: Any, builder: Any, typed: Any, values: Any) -> Any:
        return builder.inttoptr(values[0], context.get_value_type(types.voidptr))

    return types.voidptr(types.int64), generate


def _release(_context: Any) -> _Typed:
    def generate(context: Any, builder: Any, typed: Any, values: Any) -> Any:
        builder.fence("release")
        return context.get_dummy_value()

    return types.void(), generate


_run_stage = cast("Callable[[int, F64, F64, F64, F64], None]", intrinsic(_stage))
_run_limit = cast("Callable[..., int]", intrinsic(_limit))
_run_interlock = cast("Callable[..., int]", intrinsic(_interlock))
_at = cast("Callable[[int], int]", intrinsic(_pointer))
_publish = cast("Callable[[], None]", intrinsic(_release))
_floats = cast("Callable[[int, tuple[int], type], F64]", carray)
_words = cast("Callable[[int, tuple[int], type], U32]", carray)
_longs = cast("Callable[[int, tuple[int], type], I64]", carray)


@kernel("float64[::1](int64, int64)", inline=True)
def _numbers(address: int, size: int) -> F64:
    return _floats(_at(address), (size,), np.float64)


@kernel("uint32[::1](int64, int64)", inline=True)
def _bits(address: int, size: int) -> U32:
    return _words(_at(address), (size,), np.uint32)


@kernel("int64[::1](int64, int64)", inline=True)
def _integers(address: int, size: int) -> I64:
    return _longs(_at(address), (size,), np.int64)


@kernel("float64[::1](int64[::1], int64, int64)", inline=True)
def _row(table: I64, slot: int, row: int) -> F64:
    n = table[BLOCK]
    return _numbers(table[COLUMNS] + 8 * n * (table[WIDTH] * slot + row), n)


@kernel("void(float64[::1], float64[::1])", inline=True)
def _copy(values: F64, out: F64) -> None:
    for k in range(values.size):  # a copy of a slice takes numba a second to compile
        out[k] = values[k]


@kernel("void(int64[::1], float64[::1])")
def _run_stages(table: I64, wanted: F64) -> None:
    for i in range(table[STAGES]):
        at = FIRST_STAGE + STAGE_NUMBERS * i
        parameters = _numbers(table[at + 1], table[at + 2])
        memory = _numbers(table[at + 3], table[at + 4])
        _run_stage(table[at], wanted, parameters, memory, wanted)


@kernel("void(int64[::1], int64, int64)")
def begin_block(table: I64, slot: int, start: int) -> None:
    """Fill a block's reference and input, as they were planned.

    Args:
        table: See this module.
        slot: The block's.
        start: Its first sample in the waveform; all of the block lies in that.
    """
    n, at = table[BLOCK], start % table[REFERENCE_SIZE]
    _copy(_numbers(table[REFERENCE] + 8 * at, n), _row(table, slot, table[REFERENCE_ROW]))
    _copy(_numbers(table[INPUT] + 8 * at, n), _row(table, slot, table[INPUT_ROW]))


@kernel("int64(int64[::1], int64)")
def follow_block(table: I64, slot: int) -> int:
    """Work out a block's commands from its input, for the ring and for the exchange.

    Args:
        table: See this module.
        slot: The block's. Its state is filled, then wanted commands, commands and flags.

    Returns:
        Index of the first wish that is not finite, or -1.
    """
    n, size = table[BLOCK], table[STATE_SIZE]
    state = _numbers(table[STATES] + 8 * size * slot, size)
    limits = _numbers(table[LIMITS], LIMITER_NUMBERS)
    # The memory before the block, so that a replay can begin at any gap.
    _copy(_numbers(table[MEMORY], size - 1), state)
    state[size - 1] = limits[LAST]
    wanted = _row(table, slot, table[WANTED_ROW])
    _copy(_row(table, slot, table[INPUT_ROW]), wanted)
    _run_stages(table, wanted)
    command = _row(table, slot, table[COMMAND_ROW])
    first_invalid = _run_limit(
        table[LIMIT],
        wanted,
        limits[LAST],
        limits[LOW],
        limits[HIGH],
        limits[STEP],
        np.uint32(table[RANGE_BIT]),
        np.uint32(table[SLEW_BIT]),
        np.uint32(table[INVALID_BIT]),
        command,
        _bits(table[FLAGS] + 4 * n * slot, n),
    )
    limits[LAST] = command[n - 1]
    exchange = _numbers(table[EXCHANGE], 3 * n)
    _copy(command, exchange)
    for k in range(n, 3 * n):  # what no device fills is none
        exchange[k] = np.nan
    return first_invalid


@kernel("int64(int64[::1], int64, int64)")
def plan_block(table: I64, slot: int, start: int) -> int:
    """Do :func:`begin_block` and :func:`follow_block` in one call."""
    begin_block(table, slot, start)
    return follow_block(table, slot)


@kernel("int64(int64[::1], int64)")
def answer_block(table: I64, slot: int) -> int:
    """Put what an exchange brought into its block, and hold that against the interlocks.

    Args:
        table: See this module.
        slot: The block's.

    Returns:
        Index of the first sample at which one trips, or -1.
    """
    n = table[BLOCK]
    displacement_um = _row(table, slot, table[DISPLACEMENT_ROW])
    measured = _row(table, slot, table[MEASURED_ROW])
    _copy(_numbers(table[EXCHANGE] + 8 * n, n), displacement_um)
    _copy(_numbers(table[EXCHANGE] + 16 * n, n), measured)
    return _run_interlock(
        table[INTERLOCK],
        _numbers(table[SETTINGS], table[SETTINGS_SIZE]),
        _numbers(table[INTERLOCK_MEMORY], table[INTERLOCK_MEMORY_SIZE]),
        _row(table, slot, table[COMMAND_ROW]),
        _row(table, slot, table[REFERENCE_ROW]),
        displacement_um,
        measured,
        _bits(table[FLAGS] + 4 * n * slot, n),
    )


@kernel("int64[::1](int64[::1], int64)", inline=True)
def _head(host: I64, number: int) -> I64:
    size = host[HEAD_NUMBERS]
    return _integers(host[HEADS] + 8 * size * (number % host[SLOTS]), size)


@kernel("int64(int64[::1], int64[::1], int64, int64, int64, int64, int64, int64)")
def begin_tick(
    table: I64,
    host: I64,
    first_sample: int,
    start: int,
    deadline_ns: int,
    late_ns: int,
    now_ns: int,
    late_ticks: int,
) -> int:
    """Write the heartbeat, and bring the next block up to its exchange, where nothing is asked.

    Args:
        table: See this module.
        host: int64[HOST_NUMBERS], see the names above.
        first_sample: Of the block in the run.
        start: The same in the waveform.
        deadline_ns: When the tick was due, from the run's start on.
        late_ns: How late it woke.
        now_ns: When it woke, by the clock.
        late_ticks: Late ticks so far.

    Returns:
        Index of the first wish that is not finite, or -1; :data:`ASKED`, and no block is begun,
        where the supervisor asks for something or is silent, or there is no room.
    """
    numbers = _integers(host[NUMBERS], host[FIELDS])
    numbers[host[HEARTBEAT]] = now_ns
    numbers[host[NEXT_SAMPLE]] = start
    numbers[host[LATE_TICKS]] = late_ticks
    number = numbers[host[SENT]]
    asked = numbers[host[STOP]] != 0 or numbers[host[TUNE_WANTED]] != numbers[host[TUNE_TAKEN]]
    silent = now_ns - numbers[host[SUPERVISOR_HEARTBEAT]] > host[SILENCE_NS]
    if asked or silent or number - numbers[host[TAIL]] >= host[SLOTS]:
        return ASKED
    head = _head(host, number)
    head[host[HEAD_FIRST_SAMPLE]] = first_sample
    head[host[HEAD_SAMPLES]] = table[BLOCK]
    head[host[HEAD_DROPPED_BEFORE]] = 0
    head[host[HEAD_DEADLINE_NS]] = deadline_ns
    head[host[HEAD_LATE_NS]] = late_ns
    head[host[HEAD_EXCHANGE_NS]] = 0
    first_invalid = plan_block(table, number % host[SLOTS], start)
    # A fence before each number that says of others that they are there, as in the ring.
    _publish()
    head[host[HEAD_SEQUENCE]] = -number - 1
    _publish()
    numbers[host[SENT]] = number + 1
    numbers[host[ENDED_AT]] = first_sample + table[BLOCK]
    # Last: from here on the loop may be silent for as long as the device keeps it waiting.
    _publish()
    numbers[host[EXCHANGING]] = 1
    return first_invalid


@kernel("int64(int64[::1], int64[::1], int64)")
def end_tick(table: I64, host: I64, exchange_ns: int) -> int:
    """Judge the block that was sent last by what its exchange brought.

    It is handed over where no interlock trips.

    Args:
        table: See this module.
        host: See :func:`begin_tick`.
        exchange_ns: What the exchange took.

    Returns:
        Index of the first sample at which an interlock trips, or -1.
    """
    numbers = _integers(host[NUMBERS], host[FIELDS])
    number = numbers[host[SENT]] - 1
    head = _head(host, number)
    head[host[HEAD_EXCHANGE_NS]] = exchange_ns
    tripped = answer_block(table, number % host[SLOTS])
    if tripped >= 0:  # who says why needs the block, and hands it over
        return tripped
    numbers[host[EXCHANGING]] = 0
    # The sequence number last: it says that all the rest is there.
    _publish()
    head[host[HEAD_SEQUENCE]] = number + 1
    _publish()
    numbers[host[ANSWERED]] = number + 1
    return tripped
