"""From an MCAP file to a recording in memory."""

import logging
from array import array
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from mcap.records import Attachment, McapRecord, Message, Metadata

from hilctl.base.arrays import F64, I64, U32
from hilctl.base.device import CommandUnit
from hilctl.base.errors import DataError
from hilctl.base.events import Event
from hilctl.base.samples import COLUMNS, RECORDED_FIELDS, Samples
from hilctl.recording.allowance import Allowance
from hilctl.recording.checks import (
    RATES_HZ,
    SoundMessages,
    count_of,
    labels_of,
    number_of,
    segments_of,
    short,
)
from hilctl.recording.data import TICK_COLUMNS, Recording, ReplayStart, Ticks
from hilctl.recording.locks import is_being_recorded
from hilctl.recording.salvage import Salvage
from hilctl.recording.stretch import Stretch

_log = logging.getLogger(__name__)

_TEXTS = {"experiment.yaml", "model.yaml", "correction.yaml"}
_NUMBER_BYTES = 8
_EVENT_BYTES = 2048  # what Python itself takes for a message that is kept


def read(path: Path, stretch: Stretch | None = None) -> Recording:
    """Read a recording; of one that was cut short or damaged, all that is whole.

    Nothing is written. That something is missing is logged as a warning, in one line. All that is
    given out is of one shape and rises where it must, whatever the file says; time and memory stay
    in proportion to its size, or memory to that of a stretch of it.

    Args:
        path: The recording.
        stretch: What to keep of it; all where None.

    Raises:
        DataError: The file can't be read, is not an MCAP file, holds what hilctl can't have
            written, or no sample of the stretch.
    """
    try:
        with path.open("rb") as stream:
            salvage = Salvage(stream)
            contents = _Contents(salvage.allowance, stretch)
            for record in salvage.records():
                contents.take(record)
            live = not salvage.sound and is_being_recorded(stream)
    except FileNotFoundError:
        raise DataError(f"{path}: no such file") from None
    except OSError as error:
        raise DataError(f"{path}: can't be read: {error.strerror}") from None
    except DataError as error:
        raise DataError(f"{path}: {error}") from None
    if not contents.run:
        problem = "" if salvage.is_mcap else "is not an MCAP file, or its start is lost: "
        raise DataError(f"{path}: {problem}holds no run of hilctl (metadata hilctl.run is missing)")
    recording = contents.recording(path)
    if not salvage.sound:
        _warn(recording, "is still being recorded" if live else salvage.describe(), live=live)
    return stretch.cut(recording) if stretch else recording


def _warn(recording: Recording, problem: str, *, live: bool) -> None:
    advice = "" if live else " ('hilctl recover' makes it a whole file again, and keeps this one)"
    samples = recording.samples.index.size
    _log.warning("%s: %s; %d samples are read%s", recording.path, problem, samples, advice)


def _samples(index: I64, flags: U32, unit: CommandUnit, values_of: Callable[[str], F64]) -> Samples:
    """Return samples by their fields' values; of those that are left out, what stands for them.

    Raises:
        DataError: A column that every recording has is missing, or has another length.
    """
    columns: dict[str, F64] = {}
    for name, column in COLUMNS.items():
        field = column.field(unit).name
        values = values_of(field)
        if not values.size and column.otherwise:
            values = columns[column.otherwise]
        if values.size not in {index.size} | ({0} if column.when == "measured" else set()):
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


class _Contents:
    """What has been read so far: numbers in flat arrays, which many small messages don't inflate.

    Args:
        allowance: Counts what is kept.
        stretch: Blocks and ticks that lie elsewhere are not kept.
    """

    def __init__(self, allowance: Allowance, stretch: Stretch | None) -> None:
        self._allowance = allowance
        self._stretch = stretch
        self._bounds: tuple[int, int] | None = None
        self._sound = SoundMessages()
        self.run: dict[str, str] = {}
        self.end: dict[str, str] = {}
        self._texts: dict[str, str] = {}
        self._index = array("q")
        self._flags = array("I")
        self._columns = {field.name: array("d") for field in RECORDED_FIELDS}
        self._starts: list[ReplayStart] = []
        self._ticks = {name: array("q") for name in TICK_COLUMNS}
        self._events: list[tuple[int, Any]] = []

    def take(self, record: McapRecord) -> None:
        """Take a record.

        Raises:
            DataError: hilctl can't have written it.
        """
        match record:
            case Message() if self._sound.topic(record.channel_id):
                self._message(record)
            case Metadata(name="hilctl.run"):
                self.run = dict(record.metadata)
            case Metadata(name="hilctl.end"):
                self.end = dict(record.metadata)
            case Attachment() if record.name in _TEXTS:
                try:
                    self._texts[record.name] = record.data.decode()
                except UnicodeDecodeError:
                    raise DataError(f"{record.name}: is not UTF-8 text") from None
            case _:
                if problem := self._sound.problem(record):
                    raise DataError(problem)

    def _message(self, record: Message) -> None:
        decoded, problem = self._sound.decoded(record)
        if problem:
            raise DataError(f"{problem} ('hilctl recover' leaves such messages out)")
        topic = self._sound.topic(record.channel_id)
        if topic == "/samples" and self._within(decoded.tick0, decoded.tick0 + decoded.n):
            self._block(decoded)
        elif topic == "/ticks" and self._within(*_reach(decoded)):
            self._allowance.keep(_NUMBER_BYTES * len(decoded.late_ns) * len(TICK_COLUMNS))
            for name, values in self._ticks.items():
                _append(values, getattr(decoded, name))
        elif topic == "/events":
            self._allowance.keep(_EVENT_BYTES + len(record.data))
            self._events.append((record.log_time, decoded))

    def _within(self, start: int, stop: int) -> bool:
        """Return whether samples from ``start`` up to ``stop`` are of the stretch in part."""
        if self._stretch is None:
            return True
        if self._bounds is None:
            try:
                rate_hz = number_of(self.run, "sample_rate_hz", *RATES_HZ)
            except ValueError as error:
                raise DataError(f"metadata hilctl.run: missing or damaged: {error}") from None
            self._bounds = self._stretch.samples(rate_hz)
        return start < self._bounds[1] and self._bounds[0] < stop

    def _block(self, block: Any) -> None:
        self._allowance.keep(_NUMBER_BYTES * block.n * len(COLUMNS))
        _append(self._index, range(block.tick0, block.tick0 + block.n))
        _append(self._flags, block.flags)
        for name, values in self._columns.items():
            _append(values, getattr(block, name))
        for previous in block.previous_command:
            self._allowance.keep(_EVENT_BYTES + _NUMBER_BYTES * len(block.state))
            self._starts.append(ReplayStart(block.tick0, np.array(block.state), previous))

    def recording(self, path: Path) -> Recording:
        """Put it together.

        Raises:
            DataError: A fact of the run is missing or damaged, or a column is incomplete.
        """
        try:
            return self._recording(path)
        except ValueError as error:
            text = f"{path}: metadata hilctl.run or hilctl.end: missing or damaged: {error}"
            raise DataError(text) from None
        except DataError as error:
            raise DataError(f"{path}: {error}") from None

    def _recording(self, path: Path) -> Recording:
        unit = _unit(self.run)
        index = np.array(self._index, dtype=np.int64)
        flags = np.array(self._flags, dtype=np.uint32)
        return Recording(
            path=path,
            run=self.run,
            end=self.end,
            sample_rate_hz=number_of(self.run, "sample_rate_hz", *RATES_HZ),
            command_unit=unit,
            compensated=self.run.get("compensator", "none") != "none",
            segments=segments_of(self.run.get("segments", "[]")),
            samples=_samples(index, flags, unit, lambda name: np.array(self._columns[name])),
            dropped=self._dropped(),
            ticks=Ticks(**{name: np.array(values) for name, values in self._ticks.items()}),
            events=tuple(_event(time_ns, each, unit) for time_ns, each in self._events),
            experiment_yaml=self._texts.get("experiment.yaml", ""),
            model_yaml=self._texts.get("model.yaml", ""),
            correction_yaml=self._texts.get("correction.yaml", ""),
            starts=tuple(self._starts),
            labels=labels_of(self.run),
        )

    def _dropped(self) -> int:
        gaps = self._sound.next_sample - len(self._index)
        return max(gaps, count_of(self.end, "missing_samples"))


def _append(values: "array[Any]", more: Sequence[Any]) -> None:
    """Add values of a message; NumPy takes them out ten times as fast as ``extend`` does."""
    values.frombytes(np.array(more, dtype=values.typecode).tobytes())


def _reach(ticks: Any) -> tuple[int, int]:
    first = ticks.first_sample
    return min(first, default=0), max(first, default=-1) + 1


def _unit(run: Mapping[str, str]) -> CommandUnit:
    match run.get("command_unit", "A"):
        case "A":
            return "A"
        case "V":
            return "V"
        case other:
            raise ValueError(f"command_unit must be A or V, got {short(other)}")
