"""From ring batches to an MCAP file.

Metadata and attachments come first, so that a file cut short still says what it is; chunks are
closed and handed to the kernel at least every ``flush_s``, so that a killed recorder loses no more
than that.
"""

import errno
import json
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

from hilctl import __version__
from hilctl.base.events import Event
from hilctl.base.files import begins_as_recording
from hilctl.base.samples import Batch
from hilctl.base.segments import Segment
from hilctl.recording.locks import lock
from hilctl.recording.mcap_file import McapWriter
from hilctl.recording.messages import MessageMaker, RecordingLayout, Topics


@dataclass(frozen=True, slots=True)
class RunFacts:
    """What a recording says of its run before the first sample.

    Attributes:
        facts: Identity, versions, device, units; text to text.
        segments: The stretches of the run.
        experiment_yaml: The experiment as it runs.
        model_yaml: The compensator's model, or empty.
        layout: What messages are made by.
        correction_yaml: What had been learned and was added to the reference, or empty.
    """

    facts: Mapping[str, str]
    segments: tuple[Segment, ...]
    experiment_yaml: str
    model_yaml: str
    layout: RecordingLayout
    correction_yaml: str = ""


class RecordingWriter:
    """Writes one run.

    Args:
        stream: Open binary file; the writer does not close it.
        run: Facts of the run.
    """

    def __init__(self, stream: BinaryIO, run: RunFacts) -> None:
        self._writer = McapWriter(stream)
        self._topics = Topics(self._writer)
        self._maker = MessageMaker(run.layout)
        self._late_missing = 0
        self._begin(run)

    def _begin(self, run: RunFacts) -> None:
        self._writer.start(profile="", library=f"hilctl {__version__}")
        segments = json.dumps([segment.to_mapping() for segment in run.segments])
        facts = {**run.facts, **run.layout.to_facts(), "segments": segments}
        self._writer.add_metadata("hilctl.run", facts)
        start_unix_ns = run.layout.start_unix_ns
        self._attach("experiment.yaml", run.experiment_yaml, start_unix_ns)
        if run.model_yaml:
            self._attach("model.yaml", run.model_yaml, start_unix_ns)
        if run.correction_yaml:
            self._attach("correction.yaml", run.correction_yaml, start_unix_ns)
        self._topics.register()
        # Before the first sample: a file that is cut short must say what it is.
        self._writer.flush()

    def _attach(self, name: str, text: str, time_ns: int) -> None:
        self._writer.add_attachment(time_ns, time_ns, name, "application/yaml", text.encode())

    @property
    def samples(self) -> int:
        """Samples written."""
        return self._maker.samples

    @property
    def missing(self) -> int:
        """Samples known to be missing."""
        return max(self._maker.missing, self._late_missing)

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
        self._late_missing = ended_at - self.samples
        counted = {"recorded_samples": str(self.samples), "missing_samples": str(self.missing)}
        self._writer.add_metadata("hilctl.end", {**end, **counted})
        self._writer.finish()

    def event(self, event: Event) -> None:
        """Write one event."""
        self._topics.add(self._maker.event(event))

    def batch(self, batch: Batch) -> None:
        """Write all samples and ticks of a batch."""
        for message in self._maker.batch(batch):
            self._topics.add(message)


class OutputFile:
    """A recording's file, claimed before the start and given back if the run never starts.

    A file that stands there already keeps its content until :meth:`begin`.

    Args:
        path: Where to record.
        overwrite: Whether an existing file may be replaced.

    Raises:
        FileExistsError: It exists and ``overwrite`` is False.
        OSError: It can't be written, it is no recording, or another run is recording to it.
    """

    def __init__(self, path: Path, *, overwrite: bool) -> None:
        self._path = path
        self._ours = not path.exists()
        if overwrite and not self._ours and not path.is_file():
            raise OSError(errno.EINVAL, "Not a regular file", str(path))
        if overwrite and not self._ours and not begins_as_recording(path):
            text = "Not a recording, and --overwrite replaces nothing else: name another file"
            raise OSError(errno.EINVAL, text, str(path))
        # Not "wb": what stands there is emptied only once the run starts, and under the lock.
        self.stream: BinaryIO = path.open("r+b" if overwrite and not self._ours else "xb")
        lock(self.stream)

    def begin(self) -> BinaryIO:
        """Empty the file and return it, open for writing; may be called again to begin anew."""
        self.stream.seek(0)
        self.stream.truncate(0)
        return self.stream

    def give_back(self) -> None:
        """Close the file unwritten; remove it unless it stood there before."""
        with suppress(OSError):  # closing writes what a full disk has refused before
            self.stream.close()
        if self._ours:
            self._path.unlink(missing_ok=True)
