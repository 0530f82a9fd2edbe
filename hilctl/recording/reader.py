"""Reader of MCAP files, complete or in pieces."""

import logging
from collections import defaultdict
from collections.abc import Callable, Generator, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from mcap.records import Attachment, Channel, McapRecord, Message, Metadata

from hilctl.base.device import AuxChannel
from hilctl.base.errors import DataError
from hilctl.base.events import Event
from hilctl.base.files import no_such_file, open_binary, reason
from hilctl.base.samples import COLUMNS, LAST_SAMPLE, Samples
from hilctl.base.types import F64, I64, U32, CommandUnit
from hilctl.recording.codec import BlockArrays
from hilctl.recording.metadata_keys import DEVICE_FILES, unsealed
from hilctl.recording.recording import TICK_COLUMNS, Recording, ReplayStart, Ticks
from hilctl.recording.recording_files import is_being_recorded
from hilctl.recording.recovery_scan import RecoveryScan
from hilctl.recording.time_range import TimeRange, places_of
from hilctl.recording.validation import (
    RATES_HZ,
    MessageValidator,
    aux_channels_of,
    count_of,
    labels_of,
    number_of,
    segments_of,
    short,
)

_TEXTS = {"experiment.yaml", "model.yaml", "correction.yaml", "coupling.yaml"}
_NUMBER_BYTES = 8
_EVENT_BYTES = 2048  # Python objects per message


class RecordingBuilder:
    """Builder of recordings from the records of a file, in order, cut to a time range."""

    def __init__(self, scan: RecoveryScan, stretch: TimeRange | None) -> None:
        self._scan = scan
        self._budget = scan.budget
        self._stretch = stretch
        self._bounds: tuple[int, int] | None = None
        self._sound = MessageValidator()
        self._run: dict[str, str] = {}
        self._end: dict[str, str] = {}
        self._texts: dict[str, str] = {}
        self._facts: dict[str, Any] = {}
        self._recorded: set[str] | None = None
        self.samples = 0
        self._begin()

    def _begin(self) -> None:
        """Start a piece."""
        self.waiting = 0
        self._columns: dict[str, list[Any]] = defaultdict(list)
        self._starts: list[ReplayStart] = []
        self._events: list[tuple[int, Any]] = []

    def take(self, record: McapRecord) -> None:
        """Take a record."""
        match record:
            case Message() if self._sound.topic(record.channel_id):
                self._message(record)
            case Metadata(name="hilctl.run"):
                self._refuse_late("metadata hilctl.run")
                self._run, _ = unsealed(record.name, record.metadata)  # the scan notes damage
            case Metadata(name="hilctl.end"):
                self._end, _ = unsealed(record.name, record.metadata)
            case Attachment() if record.name in _TEXTS or record.name.startswith(DEVICE_FILES):
                self._refuse_late(record.name)
                try:
                    self._texts[record.name] = record.data.decode()
                except UnicodeDecodeError:
                    raise DataError(f"{record.name}: is not UTF-8 text") from None
            case _:
                if problem := self._sound.problem(record):
                    raise DataError(problem)
                if isinstance(record, Channel):
                    self._read_or_not(record.id)

    def _refuse_late(self, what: str) -> None:
        if self._facts:
            raise DataError(f"{what} follows the first samples")

    def _read_or_not(self, channel: int) -> None:
        # /scope is a copy of /samples and has 90 % of the messages at 50 kHz in blocks.
        if self._sound.topic(channel) == "/scope":
            self._scan.unread.add(channel)
        else:
            self._scan.unread.discard(channel)

    def _message(self, record: Message) -> None:
        decoded, problem = self._sound.decoded(record)
        if problem:
            raise DataError(f"{problem} ('hilctl recover' omits such messages)")
        topic = self._sound.topic(record.channel_id)
        if topic == "/samples" and self._within(decoded.tick0, decoded.tick0 + decoded.n):
            self._block(decoded)
        elif topic == "/ticks" and self._within(*_reach(decoded)):
            self._budget.keep(_NUMBER_BYTES * decoded.late_ns.size * len(TICK_COLUMNS))
            self._add({name: getattr(decoded, name) for name in TICK_COLUMNS})
        elif topic == "/events":
            self._budget.keep(_EVENT_BYTES + len(record.data))
            self._events.append((record.log_time, decoded))

    def _within(self, start: int, stop: int) -> bool:
        """Return whether samples from ``start`` up to ``stop`` overlap the time range."""
        bounds = self._stretch_bounds()
        return start < bounds[1] and bounds[0] < stop

    def _stretch_bounds(self) -> tuple[int, int]:
        if self._stretch is None:
            return 0, LAST_SAMPLE
        if self._bounds is None:
            try:
                rate_hz = number_of(self._run, "sample_rate_hz", *RATES_HZ)
            except ValueError as error:
                raise DataError(f"metadata hilctl.run: missing or damaged: {error}") from None
            self._bounds = self._stretch.samples(rate_hz)
        return self._bounds

    def _block(self, block: BlockArrays) -> None:
        self._budget.keep(_NUMBER_BYTES * block.n * (len(COLUMNS) + len(self._channels)))
        self.samples += block.n
        self.waiting += block.n
        index = np.arange(block.tick0, block.tick0 + block.n)
        columns = {**block.columns, "aux": self._aux_of(block)}
        self._add({"index": index, "flags": block.flags, **columns})
        for previous in block.previous_command.tolist():
            self._budget.keep(_EVENT_BYTES + _NUMBER_BYTES * block.state.size)
            self._starts.append(ReplayStart(block.tick0, block.state.copy(), previous))

    def _add(self, columns: Mapping[str, Any]) -> None:
        for name, values in columns.items():
            self._columns[name].append(values)

    def _pop(self, name: str, kind: Any = np.float64) -> Any:
        """Remove a column and return its values; an empty array if it is missing."""
        parts = self._columns.pop(name, [])
        return np.concatenate(parts).astype(kind, copy=False) if parts else np.empty(0, dtype=kind)

    @cached_property
    def _channels(self) -> tuple[AuxChannel, ...]:
        return aux_channels_of(self._run)

    def _aux_of(self, block: BlockArrays) -> F64:
        """Return float64[n, a], for each sample the value of its exchange; NaN if damaged."""
        width = len(self._channels)
        exchanges = block.aux.size // width if width else 0
        if not exchanges or exchanges * width != block.aux.size or block.n % exchanges:
            return np.full((block.n, width), np.nan)
        values: F64 = block.aux.reshape(exchanges, width)
        return values.repeat(block.n // exchanges, axis=0)

    def piece(self, path: Path, *, last: bool = False) -> Recording:
        """Return the records taken since the last piece; the last piece has the end of the run."""
        if not self._run:
            lost = "" if self._scan.is_mcap else "is not an MCAP file, or its start is missing: "
            text = f"{path}: {lost}holds no run of hilctl (metadata hilctl.run is missing)"
            raise DataError(text)
        try:
            piece = self._piece(path, last=last)
        except ValueError as error:
            text = f"{path}: metadata hilctl.run or hilctl.end: missing or damaged: {error}"
            raise DataError(text) from None
        except DataError as error:
            raise DataError(f"{path}: {error}") from None
        self._begin()
        return piece

    def _piece(self, path: Path, *, last: bool) -> Recording:
        self._facts = self._facts or self._identity()
        unit: CommandUnit = self._facts["command_unit"]
        gaps = self._sound.next_sample - self.samples
        return Recording(
            path=path,
            **self._facts,
            end=self._end if last else {},
            samples=self._blocks_of(unit),
            dropped=max(gaps, count_of(self._end, "missing_samples")) if last else 0,
            ticks=Ticks(**{name: self._pop(name, np.int64) for name in TICK_COLUMNS}),
            events=tuple(_event(time_ns, each, unit) for time_ns, each in self._events),
            starts=tuple(self._starts),
        )

    def _identity(self) -> dict[str, Any]:
        run = self._run
        return {
            "run": run,
            "sample_rate_hz": number_of(run, "sample_rate_hz", *RATES_HZ),
            "command_unit": _unit(run),
            "compensated": run.get("compensator", "none") != "none",
            "segments": segments_of(run.get("segments", "[]")),
            "experiment_yaml": self._texts.get("experiment.yaml", ""),
            "model_yaml": self._texts.get("model.yaml", ""),
            "correction_yaml": self._texts.get("correction.yaml", ""),
            "coupling_yaml": self._texts.get("coupling.yaml", ""),
            "device_files": {
                name.removeprefix(DEVICE_FILES): text
                for name, text in self._texts.items()
                if name.startswith(DEVICE_FILES)
            },
            "labels": labels_of(run),
            "aux_channels": self._channels,
        }

    def _blocks_of(self, unit: CommandUnit) -> Samples:
        index, flags = self._pop("index", np.int64), self._pop("flags", np.uint32)
        aux = self._pop("aux").reshape(index.size, len(self._channels))
        samples = replace(_samples(index, flags, unit, self._pop), aux=aux)
        if samples.index.size:
            recorded = {name for name, values in samples.columns().items() if values.size}
            if recorded != (self._recorded or recorded):
                names = ", ".join(sorted(recorded ^ (self._recorded or recorded)))
                raise DataError(f"/samples: a column is not in all blocks: {names}")
            self._recorded = recorded
        return samples


def _samples(index: I64, flags: U32, unit: CommandUnit, values_of: Callable[[str], F64]) -> Samples:
    """Return samples from the values of their fields; an omitted column equals another column."""
    columns: dict[str, F64] = {}
    for name, column in COLUMNS.items():
        field = column.field(unit).name
        values = values_of(field)
        if not values.size and column.otherwise:
            values = columns[column.otherwise]
        sizes = {index.size} | ({0} if column.when in {"measured", "aged", "corrected"} else set())
        if values.size not in sizes:
            counted = f"{values.size} values of {field} for {index.size} samples"
            raise DataError(f"/samples: {counted}, commands in {unit}")
        columns[name] = values
    return Samples(index=index, flags=flags, **columns)


def _event(time_ns: int, decoded: Any, unit: CommandUnit) -> Event:
    before = None
    if decoded.before_sample:
        before = _samples(
            np.array(decoded.before_sample, dtype=np.int64),
            np.array(decoded.before_flags, dtype=np.uint32),
            unit,
            lambda name: np.array(getattr(decoded, f"before_{name}"), dtype=np.float64),
        )
    return Event(
        sample=decoded.sample,
        level=decoded.level,
        code=decoded.code,
        text=decoded.text,
        values=dict(zip(decoded.value_names, decoded.values, strict=True)),
        time_ns=time_ns,
        before=before,
    )


def _reach(ticks: Ticks) -> tuple[int, int]:
    first = ticks.first_sample
    return (int(first.min()), int(first.max()) + 1) if first.size else (0, 0)


def _unit(run: Mapping[str, str]) -> CommandUnit:
    match run.get("command_unit", "A"):
        case "A":
            return "A"
        case "V":
            return "V"
        case other:
            raise ValueError(f"command_unit must be A or V, got {short(other)}")


_log = logging.getLogger(__name__)

PIECE_SAMPLES = 2**18
"""Fewest samples per piece."""


def read(path: Path, stretch: TimeRange | None = None) -> Recording:
    """Read a recording, or the valid part of a truncated or damaged one.

    Missing data is logged as one warning. Arrays have consistent lengths and indices increase,
    whatever the file contains; time and memory are in proportion to its size, or to that of the
    time range. Of a finished file, only the time range is read and checked.

    Raises:
        DataError: The file cannot be read, is not a valid recording, or has no sample in the range.
    """
    (whole,) = _read(path, stretch, None, set())
    return stretch.cut(whole) if stretch else whole


class RecordingStream:
    """A recording of any length, in pieces; each iteration reads the file again.

    Every piece is a :class:`~hilctl.recording.recording.Recording` of the next samples, ticks,
    events and replay starts. The last piece, which may have no samples, also has the end, the
    number of missing samples and the segments, cut to the time range. Joined, the pieces are the
    result of :func:`read`.
    """

    def __init__(self, path: Path, stretch: TimeRange | None = None) -> None:
        self.path = path
        self.stretch = stretch
        self._warned: set[str] = set()

    def __iter__(self) -> Iterator[Recording]:
        """Yield the pieces; raise DataError as :func:`read` does, or if facts follow samples."""
        pieces = _prefetched(_read(self.path, self.stretch, PIECE_SAMPLES, self._warned))
        return self.stretch.cut_pieces(pieces) if self.stretch else pieces


def _prefetched(pieces: Generator[Recording, None, None]) -> Iterator[Recording]:
    """Yield pieces while a thread reads the next one."""
    thread = ThreadPoolExecutor(1)
    try:
        coming = thread.submit(next, pieces, None)
        while (piece := coming.result()) is not None:
            coming = thread.submit(next, pieces, None)
            yield piece
    finally:
        thread.shutdown(wait=False)  # Ctrl-C would interrupt a wait for the piece being read


def _read(
    path: Path, stretch: TimeRange | None, piece_samples: int | None, warned: set[str]
) -> Generator[Recording, None, None]:
    """Yield pieces of at least that many samples, uncut; one piece if None.

    Each warning is added to ``warned`` and logged once.
    """
    try:
        with open_binary(path) as stream:
            places = places_of(stream, stretch) if stretch else None
            scan = RecoveryScan(stream)
            builder = RecordingBuilder(scan, stretch)
            for record in scan.records() if places is None else scan.records_at(places):
                builder.take(record)
                if piece_samples and builder.waiting >= piece_samples:
                    yield builder.piece(path)
            live = not scan.sound and is_being_recorded(stream)
    except FileNotFoundError:
        raise DataError(no_such_file(path)) from None
    except OSError as error:
        raise DataError(f"{path}: cannot be read: {reason(error)}") from None
    except DataError as error:
        text = str(error).removeprefix(f"{path}: ")  # an error of a piece has the path already
        raise DataError(f"{path}: {text}") from None
    last = builder.piece(path, last=True)
    if not scan.sound:
        problem, advice = "is still being recorded", ""
        if not live:
            problem = scan.describe()
            advice = " ('hilctl recover' repairs it and keeps the original)"
        text = f"{path}: {problem}; {builder.samples} samples read{advice}"
        if text not in warned:
            warned.add(text)
            _log.warning("%s", text)
    yield last
