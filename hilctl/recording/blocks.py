"""Samples and ticks as they are read: blocks one by one, or those of many chunks at once."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from typing import Any, TypeAlias

import numpy as np

from hilctl.base.samples import LAST_SAMPLE, LONGEST_NS
from hilctl.base.types import F64, I64, U8, U32
from hilctl.recording import wire
from hilctl.recording.checks import has_all
from hilctl.recording.chunks import Messages, kernels
from hilctl.recording.data import TICK_COLUMNS, ReplayStart, Ticks
from hilctl.recording.wire import BlockArrays

Bounds: TypeAlias = tuple[int, int]
"""The first sample to keep, and the first behind it not to keep."""

_MOST_LOOSE = 512
_ROWS = 2**18 + 2**15  # a piece, and the rest of the chunk that ends it
_TICK_ROWS = 2**14
_BYTES = 8


class Table:
    """Columns that grow; many small blocks don't inflate them."""

    def __init__(self) -> None:
        self._joined: dict[str, list[Any]] = {}
        self._loose: dict[str, list[Any]] = {}
        self._added = 0

    def add(self, columns: Mapping[str, Any]) -> None:
        """Take more rows."""
        for name, values in columns.items():
            self._loose.setdefault(name, []).append(values)
        self._added += 1
        if self._added % _MOST_LOOSE == 0:  # an array of one number takes a hundred bytes by itself
            for name, parts in self._loose.items():
                self._joined.setdefault(name, []).append(np.concatenate(parts))
            self._loose = {}

    def column(self, name: str, kind: Any) -> Any:
        """Return all values of a column, and forget them."""
        parts = [*self._joined.pop(name, []), *self._loose.pop(name, [])]
        if len(parts) == 1:
            return parts[0].astype(kind, copy=False)
        return np.concatenate(parts).astype(kind, copy=False) if parts else np.empty(0, dtype=kind)


class Blocks:
    """Samples in the order of the file."""

    def __init__(self) -> None:
        self._table = Table()
        self._fields: tuple[str, ...] = ()
        self._used = 0
        self._rows: dict[str, Any] = {"index": np.empty(0)}

    def add(self, block: BlockArrays) -> None:
        """Take a block, which has been checked."""
        self._put_away()
        index = np.arange(block.tick0, block.tick0 + block.n)
        self._table.add({"index": index, "flags": block.flags, **block.columns})
        self._fields = tuple(block.columns)

    def add_all(
        self, messages: Messages, rows: I64, next_sample: int, bounds: Bounds
    ) -> tuple[int, int, list[ReplayStart]] | None:
        """Take the blocks of some chunks that lie within bounds, if every one is plain.

        That is one that :func:`hilctl.recording.checks.block_problem` finds nothing in, and that
        has the columns of the block before.

        Args:
            messages: The messages of some chunks.
            rows: int64[m, PLACES], those with blocks.
            next_sample: Index after the last sample before them.
            bounds: What to keep of them, in whole blocks.

        Returns:
            The index after the last of them, samples kept, and where a replay can begin. None where
            one is not plain: then none was taken.
        """
        found = _lists(messages, rows, wire.BLOCK_KINDS)
        if found is None or not has_all(("flags", *self._fields)):
            return None
        numbers, starts, sizes = found
        firsts, counts = numbers[:, wire.TICK0], numbers[:, wire.N]
        ends = np.concatenate(([next_sample], firsts + counts))
        plain = (
            (counts > 0).all()
            and (counts < wire.LARGEST_N).all()
            and (firsts < LAST_SAMPLE).all()
            and (firsts >= ends[:-1]).all()
            and (sizes[:, _COLUMNS] == _sizes(self._fields) * counts[:, None]).all()
            and not (sizes[:, [wire.T_REL, wire.STATE, wire.PREVIOUS]] % _BYTES).any()
            and (sizes[:, wire.PREVIOUS] <= _BYTES).all()
        )
        if not plain:
            return None
        kept = (firsts < bounds[1]) & (ends[1:] > bounds[0])
        blocks = _Found(messages.data, firsts[kept], counts[kept], starts[kept], sizes[kept])
        begun = blocks.begun()
        if begun is None or not self._copy(blocks):
            return None
        return int(ends[-1]), int(blocks.counts.sum()), begun

    def _copy(self, blocks: "_Found") -> bool:
        """Copy the columns of plain blocks; return False where their flags are none."""
        packed, data, counts = kernels(), blocks.data, blocks.counts
        samples = int(counts.sum())
        if not samples:
            return True
        if samples > self._rows["index"].size - self._used:
            self._make_room(samples)
        at, rows, found = self._used, self._rows, np.empty_like(counts)
        flags = blocks.lists(wire.FLAGS)
        end = packed.join_varints(data, *flags, _LARGEST_FLAGS, rows["flags"], at, found)
        if end < 0 or (found != counts).any():
            return False
        packed.join_ranges(blocks.firsts, counts, rows["index"], at)
        for name in self._fields:
            column = blocks.lists(wire.NUMBER_OF[name])
            packed.join_bytes(data, *column, rows[name].view(np.uint8), _BYTES * at)
        self._used += samples
        return True

    def _make_room(self, samples: int) -> None:
        self._put_away()
        size = max(_ROWS, samples)
        self._rows = {name: np.empty(size) for name in self._fields}
        self._rows["index"] = np.empty(size, dtype=np.int64)
        self._rows["flags"] = np.empty(size, dtype=np.uint32)

    def _put_away(self) -> None:
        if self._used:
            used = slice(self._used)
            self._table.add({name: values[used] for name, values in self._rows.items()})
        self._rows, self._used = {"index": np.empty(0)}, 0

    def index_and_flags(self) -> tuple[I64, U32]:
        """Return index and flags of all samples, and forget them."""
        self._put_away()
        return self._table.column("index", np.int64), self._table.column("flags", np.uint32)

    def column(self, name: str) -> F64:
        """Return a column by the name of its field, and forget it; empty where there is none."""
        values: F64 = self._table.column(name, np.float64)
        return values


class TickTable:
    """Timing of ticks in the order of the file."""

    def __init__(self) -> None:
        self._table = Table()
        self._used = 0
        self._rows = np.empty((len(TICK_COLUMNS), 0), dtype=np.int64)

    def add(self, ticks: Ticks) -> None:
        """Take more of them, which have been checked."""
        self._put_away()
        self._table.add({name: getattr(ticks, name) for name in TICK_COLUMNS})

    def add_all(self, messages: Messages, rows: I64, bounds: Bounds) -> int | None:
        """Take the ticks of some chunks, if every message is plain.

        That is one that :func:`hilctl.recording.checks.ticks_problem` finds nothing in.

        Args:
            messages: The messages of some chunks.
            rows: int64[m, PLACES], those with ticks.
            bounds: None is kept where all lie before or behind them.

        Returns:
            How many were kept; None where one is not plain: then none was taken.
        """
        found = _lists(messages, rows, wire.TICK_KINDS)
        if found is None:
            return None
        _, starts, sizes = found
        most = int(sizes.sum(axis=0).max())  # each takes a byte at least
        if most > self._rows.shape[1] - self._used:
            self._put_away()
            self._rows = np.empty((len(TICK_COLUMNS), max(_TICK_ROWS, most)), dtype=np.int64)
        counts = np.empty((len(TICK_COLUMNS), len(rows)), dtype=np.int64)
        end = self._used
        for row, out in enumerate(self._rows):
            first = np.ascontiguousarray(starts[:, row + 1])
            size = np.ascontiguousarray(sizes[:, row + 1])
            # Twice as large before its sign is taken out of its lowest bit.
            largest = 2 * LONGEST_NS if row else LAST_SAMPLE - 1
            end = kernels().join_varints(
                messages.data, first, size, largest, out, self._used, counts[row]
            )
            if end < 0:
                return None
        if (counts != counts[0]).any():
            return None
        firsts = self._rows[0, self._used : end]
        if not ((firsts < bounds[1]).any() and (firsts >= bounds[0]).any()):
            return 0
        times = self._rows[1:, self._used : end]
        times[:] = wire.signed(times.view(np.uint64))
        taken, self._used = end - self._used, end
        return taken

    def _put_away(self) -> None:
        if self._used:
            rows = zip(TICK_COLUMNS, self._rows, strict=True)
            self._table.add({name: values[: self._used] for name, values in rows})
        self._rows, self._used = self._rows[:, :0], 0

    def ticks(self) -> Ticks:
        """Return all of them, and forget them."""
        self._put_away()
        return Ticks(**{name: self._table.column(name, np.int64) for name in TICK_COLUMNS})


def _lists(messages: Messages, rows: I64, kinds: I64) -> tuple[I64, I64, I64] | None:
    """Return numbers, and places and bytes of lists: int64[m, f] each; None where not plain."""
    shape = len(rows), kinds.size
    numbers, starts, sizes = (np.empty(shape, dtype=np.int64) for _ in range(3))
    plain = kernels().find_fields(messages.data, rows, kinds, numbers, starts, sizes)
    return (numbers, starts, sizes) if plain else None


@dataclass(frozen=True, slots=True)
class _Found:
    """Plain blocks among the messages of some chunks.

    Attributes:
        data: uint8[n], what the chunks hold.
        firsts: int64[m], index of the first sample of each.
        counts: int64[m], samples.
        starts: int64[m, f], where the list of each field begins.
        sizes: int64[m, f], its bytes.
    """

    data: U8
    firsts: I64
    counts: I64
    starts: I64
    sizes: I64

    def lists(self, field: int) -> tuple[I64, I64]:
        """Return where the lists of a field begin, and their bytes: int64[m] each."""
        return self.starts[:, field].copy(), self.sizes[:, field].copy()

    def begun(self) -> list[ReplayStart] | None:
        """Return where a replay can begin; None where the command before that is none."""
        starts = []
        for row in np.flatnonzero(self.sizes[:, wire.PREVIOUS]).tolist():
            state, previous = (self._doubles(row, field) for field in (wire.STATE, wire.PREVIOUS))
            if not np.isfinite(previous).all():
                return None
            starts.append(ReplayStart(int(self.firsts[row]), state, previous.item()))
        return starts

    def _doubles(self, row: int, field: int) -> F64:
        start = self.starts[row, field]
        return self.data[start : start + self.sizes[row, field]].copy().view(np.float64)


_COLUMNS = np.array(list(wire.NUMBER_OF.values()))
_LARGEST_FLAGS = int(np.iinfo(np.uint32).max)


@cache
def _sizes(fields: tuple[str, ...]) -> I64:
    """Return the bytes a sample of each column of :data:`_COLUMNS`, where these are recorded."""
    return np.array([_BYTES if name in fields else 0 for name in wire.NUMBER_OF])
