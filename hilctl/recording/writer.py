"""From ring batches to an MCAP file.

Metadata and attachments come first, so that a file cut short still says what it is; chunks are
closed and handed to the kernel at least every ``flush_s``, so that a killed recorder loses no more
than that.
"""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np
from mcap.writer import CompressionType, Writer

from hilctl import __version__
from hilctl.arrays import F64, U32
from hilctl.ports import CommandUnit
from hilctl.recording import schema
from hilctl.recording.data import Event
from hilctl.ring import Batch, Head
from hilctl.segments import Segment

_COLUMNS = {
    "A": ("wanted_a", "current_a", "measured_a"),
    "V": ("wanted_v", "drive_v", "measured_v"),
}
_MAX_BLOCK = 500


@dataclass(frozen=True, slots=True)
class RunFacts:
    """What a recording says of its run before the first sample.

    Attributes:
        facts: Identity, versions, device, units; text to text.
        segments: The stretches of the run.
        experiment_yaml: The experiment as it runs.
        model_yaml: The compensator's model, or empty.
        sample_rate_hz: Samples a second.
        command_unit: ``A`` or ``V``.
        measures_command: Whether the device measures its command.
        scope_rate_hz: Highest rate of ``/scope``.
    """

    facts: Mapping[str, str]
    segments: tuple[Segment, ...]
    experiment_yaml: str
    model_yaml: str
    sample_rate_hz: float
    command_unit: CommandUnit
    measures_command: bool
    scope_rate_hz: float


class RecordingWriter:
    """Writes one run.

    Args:
        stream: Open binary file; the writer does not close it.
        run: Facts of the run.
        start_unix_ns: Unix time of sample 0 in ns.
    """

    def __init__(self, stream: BinaryIO, run: RunFacts, start_unix_ns: int) -> None:
        self._run = run
        self._start_unix_ns = start_unix_ns
        self._writer = Writer(stream, compression=CompressionType.ZSTD)
        self._stride = max(1, int(np.ceil(run.sample_rate_hz / run.scope_rate_hz)))
        self._sequence = dict.fromkeys(schema.TOPICS, 0)
        self._next_sample = 0
        self.samples = 0
        self.missing = 0
        self._begin()

    def _begin(self) -> None:
        writer, run = self._writer, self._run
        writer.start(profile="", library=f"hilctl {__version__}")
        segments = json.dumps([segment.to_mapping() for segment in run.segments])
        writer.add_metadata("hilctl.run", {**run.facts, "segments": segments})
        self._attach("experiment.yaml", run.experiment_yaml)
        if run.model_yaml:
            self._attach("model.yaml", run.model_yaml)
        descriptors = schema.descriptor_set()
        self._channels = {
            topic: writer.register_channel(
                topic=topic,
                message_encoding="protobuf",
                schema_id=writer.register_schema(f"hilctl.{name}", "protobuf", descriptors),
            )
            for topic, name in schema.TOPICS.items()
        }
        writer.flush()

    def _attach(self, name: str, text: str) -> None:
        time_ns = self._start_unix_ns
        self._writer.add_attachment(time_ns, time_ns, name, "application/yaml", text.encode())

    def flush(self) -> None:
        """Close the chunk in work and hand it to the kernel."""
        self._writer.flush()

    def finish(self, end: Mapping[str, str], ended_at: int) -> None:
        """Write the facts of the end, the index and the footer.

        Args:
            end: Facts of the end.
            ended_at: Index after the last sample that was exchanged; what is not recorded before
                it is missing, also where no later block could say so.
        """
        self.missing = max(self.missing, ended_at - self.samples)
        counted = {"recorded_samples": str(self.samples), "missing_samples": str(self.missing)}
        self._writer.add_metadata("hilctl.end", {**end, **counted})
        self._writer.finish()

    def event(self, event: Event) -> None:
        """Write one event."""
        out = schema.message("Event")
        out.sample, out.level, out.code, out.text = (
            event.sample,
            event.level,
            event.code,
            event.text,
        )
        self._add("/events", event.time_ns, out.SerializeToString())

    def batch(self, batch: Batch) -> None:
        """Write all samples and ticks of a batch."""
        firsts = batch.heads[:, Head.FIRST_SAMPLE]
        gaps = batch.heads[:, Head.DROPPED_BEFORE]
        block = batch.flags.shape[1]
        largest = max(1, _MAX_BLOCK // block)
        row = 0
        while row < firsts.size:
            stop = row + 1
            while stop < firsts.size and stop - row < largest and gaps[stop] == 0:
                stop += 1
            self._block(batch, row, stop)
            row = stop
        self._ticks(batch)

    def _block(self, batch: Batch, row: int, stop: int) -> None:
        rows = slice(row, stop)
        first = int(batch.heads[row, Head.FIRST_SAMPLE])
        flags = batch.flags[rows].ravel()
        columns = batch.columns[rows].transpose(1, 0, 2).reshape(5, -1)
        dropped = int(batch.heads[row, Head.DROPPED_BEFORE])
        t_rel = (first + np.arange(flags.size)) / self._run.sample_rate_hz
        wanted, command, measured = _COLUMNS[self._run.command_unit]
        out = schema.message("SampleBlock")
        out.tick0, out.n, out.dropped = first, flags.size, dropped
        out.t_rel.extend(t_rel.tolist())
        out.flags.extend(flags.tolist())
        out.reference_um.extend(columns[0].tolist())
        getattr(out, wanted).extend(columns[1].tolist())
        getattr(out, command).extend(columns[2].tolist())
        out.displacement_um.extend(columns[3].tolist())
        if self._run.measures_command:
            getattr(out, measured).extend(columns[4].tolist())
        if self.samples == 0 or dropped:
            out.state.extend(batch.states[row, :-1].tolist())
            out.previous_command.append(float(batch.states[row, -1]))
        self._add("/samples", self._time_ns(first), out.SerializeToString())
        self.samples += flags.size
        self.missing += dropped
        self._scope(first, t_rel, columns, flags)

    def _scope(self, first: int, t_rel: F64, columns: F64, flags: U32) -> None:
        wanted, command, _ = _COLUMNS[self._run.command_unit]
        for k in range(-first % self._stride, flags.size, self._stride):
            out = schema.message("Sample")
            out.sample, out.t_rel, out.flags = first + k, t_rel[k], int(flags[k])
            out.reference_um, out.displacement_um = columns[0, k], columns[3, k]
            setattr(out, wanted, columns[1, k])
            setattr(out, command, columns[2, k])
            self._add("/scope", self._time_ns(first + k), out.SerializeToString())

    def _ticks(self, batch: Batch) -> None:
        out = schema.message("TickBlock")
        heads = batch.heads
        out.first_sample.extend(heads[:, Head.FIRST_SAMPLE].tolist())
        out.deadline_ns.extend(heads[:, Head.DEADLINE_NS].tolist())
        out.late_ns.extend(heads[:, Head.LATE_NS].tolist())
        out.exchange_ns.extend(heads[:, Head.EXCHANGE_NS].tolist())
        first = int(heads[0, Head.FIRST_SAMPLE])
        self._add("/ticks", self._time_ns(first), out.SerializeToString())

    def _time_ns(self, sample: int) -> int:
        return self._start_unix_ns + round(sample * 1e9 / self._run.sample_rate_hz)

    def _add(self, topic: str, time_ns: int, data: bytes) -> None:
        self._writer.add_message(
            self._channels[topic],
            log_time=time_ns,
            data=data,
            publish_time=time_ns,
            sequence=self._sequence[topic],
        )
        self._sequence[topic] += 1


class OutputFile:
    """A recording's file, claimed before the start and given back if the run never starts.

    A file that stands there already keeps its content until :meth:`begin`.

    Args:
        path: Where to record.
        overwrite: Whether an existing file may be replaced.

    Raises:
        FileExistsError: It exists and ``overwrite`` is False.
        OSError: It can't be written.
    """

    def __init__(self, path: Path, *, overwrite: bool) -> None:
        self._path = path
        self._ours = not path.exists()
        self.stream: BinaryIO = path.open("r+b" if overwrite and not self._ours else "xb")

    def begin(self) -> BinaryIO:
        """Empty the file and return it, open for writing."""
        if not self._ours:
            self.stream.truncate(0)
        return self.stream

    def give_back(self) -> None:
        """Close the file unwritten; remove it unless it stood there before."""
        self.stream.close()
        if self._ours:
            self._path.unlink()
