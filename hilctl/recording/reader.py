"""From an MCAP file to a recording in memory."""

import json
import logging
from pathlib import Path
from typing import Any

import numpy as np
from google.protobuf.message import DecodeError
from mcap.records import Attachment, Channel, Message, Metadata

from hilctl.base.arrays import F64
from hilctl.base.errors import DataError
from hilctl.base.segments import Segment
from hilctl.recording import schema
from hilctl.recording.data import Event, Recording, Samples, Start, Ticks
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


def _event(time_ns: int, decoded: Any) -> Event:
    before = None
    if decoded.before_sample:
        small = "v" if decoded.before_drive_v else "a"
        command = decoded.before_drive_v or decoded.before_current_a
        before = Samples(
            index=np.array(decoded.before_sample, dtype=np.int64),
            reference_um=np.array(decoded.before_reference_um),
            wanted=np.array(getattr(decoded, f"before_wanted_{small}")),
            command=np.array(command),
            measured=np.empty(0),
            displacement_um=np.array(decoded.before_displacement_um),
            flags=np.array(decoded.before_flags, dtype=np.uint32),
        )
    return Event(time_ns, decoded.sample, decoded.level, decoded.code, decoded.text, before)


class _Contents:
    """What has been read so far."""

    def __init__(self) -> None:
        self.run: dict[str, str] = {}
        self.end: dict[str, str] = {}
        self._texts: dict[str, str] = {}
        self._topics: dict[int, str] = {}
        self._blocks: list[Any] = []
        self._ticks: list[Any] = []
        self._events: list[Event] = []

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
            self._events.append(_event(record.log_time, decoded))

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
        unit = "V" if self.run.get("command_unit") == "V" else "A"
        return Recording(
            path=path,
            run=self.run,
            end=self.end,
            sample_rate_hz=float(self.run["sample_rate_hz"]),
            command_unit="V" if unit == "V" else "A",
            compensated=self.run.get("compensator", "none") != "none",
            segments=tuple(
                Segment.from_mapping(each) for each in json.loads(self.run.get("segments", "[]"))
            ),
            samples=self._samples(unit),
            dropped=self._dropped(),
            ticks=self._all_ticks(),
            events=tuple(self._events),
            experiment_yaml=self._texts.get("experiment.yaml", ""),
            model_yaml=self._texts.get("model.yaml", ""),
            correction_yaml=self._texts.get("correction.yaml", ""),
            starts=tuple(
                Start(block.tick0, np.array(block.state), block.previous_command[0])
                for block in self._blocks
                if block.previous_command
            ),
        )

    def _dropped(self) -> int:
        recorded: int = sum(block.n for block in self._blocks)
        last = self._blocks[-1] if self._blocks else None
        gaps = last.tick0 + last.n - recorded if last else 0
        return max(gaps, int(self.end.get("missing_samples", "0")))

    def _samples(self, unit: str) -> Samples:
        small = unit.lower()
        command = "current_a" if unit == "A" else "drive_v"
        ranges = [np.arange(b.tick0, b.tick0 + b.n, dtype=np.int64) for b in self._blocks]
        return Samples(
            index=np.concatenate(ranges) if ranges else np.empty(0, dtype=np.int64),
            reference_um=self._column("reference_um"),
            wanted=self._column(f"wanted_{small}"),
            command=self._column(command),
            measured=self._column(f"measured_{small}"),
            displacement_um=self._column("displacement_um"),
            flags=self._column("flags").astype(np.uint32),
            input_um=self._column("input_um"),
        )

    def _column(self, name: str) -> F64:
        parts = [np.array(getattr(block, name), dtype=np.float64) for block in self._blocks]
        return np.concatenate(parts) if parts else np.empty(0)

    def _all_ticks(self) -> Ticks:
        names = ("first_sample", "deadline_ns", "late_ns", "exchange_ns")
        columns = [
            np.concatenate(
                [np.array(getattr(tick, name), dtype=np.int64) for tick in self._ticks]
                or [np.empty(0, dtype=np.int64)]
            )
            for name in names
        ]
        return Ticks(*columns)
