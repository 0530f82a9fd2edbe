"""Ordered access to counters in shared memory that announce other data.

A reader must see data before the number that announces them. x86-64 keeps the order of writes and
reads, ARM64 does not, and Python cannot request it. Therefore these kernels use LLVM instructions:
a store with release order and a load with acquire order. They also order later writes after a
store, and earlier reads before a load, so a reader can copy data and check afterwards that they
were valid.

A number that announces nothing needs no such order: access to eight aligned bytes is atomic.
"""

from collections.abc import Callable
from typing import Annotated, Any, TypeAlias, cast

from numba import types
from numba.extending import intrinsic

from hilctl.base.types import I64
from hilctl.kernels.jit import DISABLED, kernel

_Typed: TypeAlias = tuple[Any, Callable[..., Any]]
_BYTES = 8


def _place(context: Any, builder: Any, array: Any, values: Any) -> Any:
    """Return a pointer to the number at an index of an array."""
    made = context.make_array(array)(context, builder, values[0])
    return builder.gep(made.data, [values[1]])


def _typed_store(_context: Any, numbers: Any, index: Any, value: Any) -> _Typed:
    def generate(context: Any, builder: Any, typed: Any, values: Any) -> Any:
        place = _place(context, builder, typed.args[0], values)
        builder.store_atomic(values[2], place, "release", _BYTES)
        builder.fence("seq_cst")
        return context.get_dummy_value()

    return types.void(numbers, index, value), generate


def _typed_load(_context: Any, numbers: Any, index: Any) -> _Typed:
    def generate(context: Any, builder: Any, typed: Any, values: Any) -> Any:
        builder.fence("acquire")
        place = _place(context, builder, typed.args[0], values)
        return builder.load_atomic(place, "acquire", _BYTES)

    return types.int64(numbers, index), generate


def _plain_store(numbers: I64, index: int, value: int) -> None:
    numbers[index] = value


def _plain_load(numbers: I64, index: int) -> int:
    return int(numbers[index])


_ReadOnly: TypeAlias = Annotated[I64, "Array(int64, 1, 'C', readonly=True)"]

# Without the compiler, such as in a debugger, the processor determines the order.
_store: Callable[[I64, int, int], None] = _plain_store
_load: Callable[[I64, int], int] = _plain_load
if not DISABLED:
    _store, _load = cast("Any", intrinsic(_typed_store)), cast("Any", intrinsic(_typed_load))


@kernel()
def publish(numbers: I64, index: int, value: int) -> None:
    """Set a number after all earlier writes and before all later ones.

    ``numbers`` is int64[n] in shared memory; the index is not checked.
    """
    _store(numbers, index, value)


@kernel()
def observe(numbers: _ReadOnly, index: int) -> int:
    """Return a number, read after all earlier reads and before all later ones.

    ``numbers`` is int64[n] in shared memory, possibly read-only; the index is not checked.
    """
    return _load(numbers, index)
