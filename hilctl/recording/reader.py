"""From an MCAP file to a recording in memory."""

import json
import logging
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from google.protobuf.message import DecodeError
from mcap.records import Attachment, Channel, Message, Metadata

from hilctl.base.arrays import F64, I64
from hilctl.base.device import CommandUnit
from hilctl.base.errors import DataError
from hilctl.base.events import Event
from hilctl.base.samples import COLUMNS, Samples
from hilctl.base.segments import Segment
from hilctl.recording import schema
from hilctl.recording.data import TICK_COLUMNS, Recording, ReplayStart, Ticks
from hilctl.recording.salvage import Salvage
from hilctl.recording.writer import is_being_recorded

_log = logging.getLogger(__name__)


def read(path: Path) -> Recording:
    """Read a recording; of one that was cut short or damaged, all that is whole.

    Nothing is written. That something is missing is logged as a warning, in one line.

    Raises:
        DataError: The file can't be read, is not an MCAP file, or was not written by hilctl.
    """
    contents = _Contents()
    try:
        with path.open("rb") as stream:
            salvage = Salvage(stream)
            for record in salvage.records():
                contents.take(record)
            live = not salvage.sound and is_being_recorded(stream)
    except FileNotFoundError:
        raise DataError(f"{path}: no such file") from None
    except OSError as error:
        raise DataError(f"{path}: can't be read: {error.strerror}") from None
    except (DecodeError, UnicodeDecodeError) as error:
        raise DataError(f"{path}: holds what hilctl did not write: {error}") from None
    if not contents.run:
        problem = "" if salvage.is_mcap else "is not an MCAP file, or its start is lost: "
        raise DataError(f"{path}: {problem}holds no run of hilctl (metadata hilctl.run is missing)")
    recording = contents.recording(path)
    if not salvage.sound:
        _warn(recording, "is still being recorded" if live else salvage.describe(), live=live)
    return recording


def _warn(recording: Recording, problem: str, *, live: bool) -> None:
    advice = "" if live else " ('hilctl recover' makes it a whole file again, and keeps this one)"
    samples = recording.samples.index.size
    _log.warning("%s: %s; %d samples are read%s", recording.path, problem, samples, advice)


def _samples(index: I64, flags: F64, unit: CommandUnit, field: Callable[[str], F64]) -> Samples:
    """Return samples by their fields' values; of those that are left out, what stands for them."""
    columns: dict[str, F64] = {}
    for name, column in COLUMNS.items():
        values = field(column.field(unit).name)
        left_out = column.otherwise and not values.size
        columns[name] = columns[column.otherwise] if left_out else values
    return Samples(index=index, flags=flags.astype(np.uint32), **columns)


def _event(time_ns: int, decoded: Any, unit: CommandUnit) -> Event:
    before = None
    if decoded.before_sample:
        before = _samples(
            np.array(decoded.before_sample, dtype=np.int64),
            np.array(decoded.before_flags),
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
    """What has been read so far."""

    def __init__(self) -> None:
        self.run: dict[str, str] = {}
        self.end: dict[str, str] = {}
        self._texts: dict[str, str] = {}
        self._topics: dict[int, str] = {}
        self._blocks: list[Any] = []
        self._ticks: list[Any] = []
        self._events: list[tuple[int, Any]] = []

    def take(self, record: Any) -> None:
        match record:
            case Message():
                self._message(record)
            case Channel():
                self._topics[record.id] = record.topic
            case Metadata(name="hilctl.run"):
                self.run = dict(record.metadata)
            case Metadata(name="hilctl.end"):
                self.end = dict(record.metadata)
            case Attachment():
                self._texts[record.name] = record.data.decode()

    def _message(self, record: Message) -> None:
        topic = self._topics.get(record.channel_id, "")
        if topic not in {"/samples", "/ticks", "/events"}:
            return
        decoded: Any = schema.message_class(schema.TOPICS[topic]).FromString(record.data)
        if topic == "/samples":
            self._blocks.append(decoded)
        elif topic == "/ticks":
            self._ticks.append(decoded)
        else:
            self._events.append((record.log_time, decoded))

    def recording(self, path: Path) -> Recording:
        """Put it together.

        Raises:
            DataError: A fact of the run is missing or damaged.
        """
        try:
            return self._recording(path)
        except (KeyError, ValueError, TypeError) as error:
            text = f"{path}: metadata hilctl.run or hilctl.end: missing or damaged: {error}"
            raise DataError(text) from None

    def _recording(self, path: Path) -> Recording:
        unit: CommandUnit = "V" if self.run.get("command_unit") == "V" else "A"
        return Recording(
            path=path,
            run=self.run,
            end=self.end,
            sample_rate_hz=float(self.run["sample_rate_hz"]),
            command_unit=unit,
            compensated=self.run.get("compensator", "none") != "none",
            segments=tuple(
                Segment.from_mapping(each) for each in json.loads(self.run.get("segments", "[]"))
            ),
            samples=_samples(self._index(), self._column("flags"), unit, self._column),
            dropped=self._dropped(),
            ticks=self._all_ticks(),
            events=tuple(_event(time_ns, each, unit) for time_ns, each in self._events),
            experiment_yaml=self._texts.get("experiment.yaml", ""),
            model_yaml=self._texts.get("model.yaml", ""),
            correction_yaml=self._texts.get("correction.yaml", ""),
            starts=tuple(
                ReplayStart(block.tick0, np.array(block.state), block.previous_command[0])
                for block in self._blocks
                if block.previous_command
            ),
        )

    def _dropped(self) -> int:
        recorded: int = sum(block.n for block in self._blocks)
        last = self._blocks[-1] if self._blocks else None
        gaps = last.tick0 + last.n - recorded if last else 0
        return max(gaps, int(self.end.get("missing_samples", "0")))

    def _index(self) -> I64:
        ranges = [np.arange(b.tick0, b.tick0 + b.n, dtype=np.int64) for b in self._blocks]
        return np.concatenate(ranges) if ranges else np.empty(0, dtype=np.int64)

    def _column(self, name: str) -> F64:
        parts = [np.array(getattr(block, name), dtype=np.float64) for block in self._blocks]
        return np.concatenate(parts) if parts else np.empty(0)

    def _all_ticks(self) -> Ticks:
        nothing = np.empty(0, dtype=np.int64)
        parts = {
            name: [np.array(getattr(each, name), dtype=np.int64) for each in self._ticks]
            for name in TICK_COLUMNS
        }
        return Ticks(**{name: np.concatenate([nothing, *each]) for name, each in parts.items()})
