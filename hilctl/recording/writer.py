"""Writer of a run's MCAP file, and its output file.

Metadata and attachments come first, so that a truncated file can be identified. Chunks are closed
and written every ``flush_s``, which limits the loss if the recorder is killed.
"""

import errno
import json
import os
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from io import FileIO
from pathlib import Path
from typing import IO, cast

from mcap.writer import Writer

from hilctl import __version__
from hilctl.base.events import Event
from hilctl.base.files import begins_as_recording
from hilctl.base.samples import BlockBatch
from hilctl.base.segments import Segment
from hilctl.recording.encoder import MessageMaker, RecordingLayout, Topics
from hilctl.recording.metadata_keys import AXIS_FACT, DEVICE_FILES, sealed
from hilctl.recording.recording_files import lock

_CHUNK_BYTES = 5 << 20
"""Size of a full chunk: about 2 s of samples at 50 kHz, the default flush interval."""


def mcap_writer(stream: "IO[bytes] | PendingFile") -> Writer:
    """Return a writer of compressed chunks with all checksums; it does not close the stream."""
    return Writer(cast(IO[bytes], stream), chunk_size=_CHUNK_BYTES, enable_data_crcs=True)


@dataclass(frozen=True, slots=True)
class RunFacts:
    """Description of a run, recorded before its first sample; missing texts are empty."""

    facts: Mapping[str, str]
    segments: tuple[Segment, ...]
    experiment_yaml: str
    model_yaml: str
    layout: RecordingLayout
    correction_yaml: str = ""
    coupling_yaml: str = ""
    device_files: Mapping[str, str] = field(default_factory=dict)


class RecordingWriter:
    """Writer of one run; it does not close its stream."""

    def __init__(self, stream: "IO[bytes] | PendingFile", run: RunFacts) -> None:
        self._writer = mcap_writer(stream)
        self._topics = Topics(self._writer, run.facts.get(AXIS_FACT, ""))
        self._maker = MessageMaker(run.layout)
        self._late_missing = 0
        self._begin(run)

    def _begin(self, run: RunFacts) -> None:
        self._writer.start(profile="", library=f"hilctl {__version__}")
        segments = json.dumps([segment.to_mapping() for segment in run.segments])
        facts = {**run.facts, **run.layout.to_facts(), "segments": segments}
        self._writer.add_metadata("hilctl.run", sealed("hilctl.run", facts))
        start_unix_ns = run.layout.start_unix_ns
        texts = {"experiment.yaml": run.experiment_yaml}
        texts |= {"model.yaml": run.model_yaml} if run.model_yaml else {}
        texts |= {"correction.yaml": run.correction_yaml} if run.correction_yaml else {}
        texts |= {"coupling.yaml": run.coupling_yaml} if run.coupling_yaml else {}
        texts |= {f"{DEVICE_FILES}{name}": text for name, text in run.device_files.items()}
        for name, text in texts.items():
            times = start_unix_ns, start_unix_ns
            self._writer.add_attachment(*times, name, "application/yaml", text.encode())
        self._topics.register()
        self._writer.flush()

    @property
    def samples(self) -> int:
        """Samples written."""
        return self._maker.samples

    @property
    def missing(self) -> int:
        """Samples known to be missing."""
        return max(self._maker.missing, self._late_missing)

    def flush(self) -> None:
        """Close the current chunk and write it."""
        self._writer.flush()

    def finish(self, end: Mapping[str, str], ended_at: int) -> None:
        """Write facts of the end, index and footer; samples before ``ended_at`` are missing."""
        self._late_missing = ended_at - self.samples
        counted = {"recorded_samples": str(self.samples), "missing_samples": str(self.missing)}
        self._writer.add_metadata("hilctl.end", sealed("hilctl.end", {**end, **counted}))
        self._writer.finish()

    def event(self, event: Event) -> None:
        """Write one event."""
        self._topics.add(self._maker.event(event))

    def batch(self, batch: BlockBatch) -> None:
        """Write all samples and ticks of a batch."""
        for message in self._maker.batch(batch):
            self._topics.add(message)


_MOST_PENDING_BYTES = 1 << 20


class PendingFile:
    """A file that buffers writes in memory until the disk accepts them.

    :meth:`write` never fails, so an MCAP writer stays consistent. A failed :meth:`flush` loses
    nothing: the next one starts where the last complete one ended.

    Attributes:
        problem: Error of the last attempt to write; empty if it succeeded.
    """

    def __init__(self, raw: FileIO, *, sync: bool = False) -> None:
        self._raw, self._sync_always = raw, sync
        self._pending: list[bytes] = []
        self._pending_bytes = self._written = self._synced = 0
        self._lost: OSError | None = None
        self.problem = ""

    def write(self, data: bytes | bytearray | memoryview) -> int:
        """Append bytes; this call or the next :meth:`flush` writes them."""
        self._pending.append(bytes(data))
        self._pending_bytes += len(data)
        if self._pending_bytes > _MOST_PENDING_BYTES:  # a run without a ring never flushes
            with suppress(OSError):  # they stay pending, and `problem` has the error
                self.flush()
        return len(data)

    def tell(self) -> int:
        """Return the size of the file, pending bytes included."""
        return self._written + self._pending_bytes

    def flush(self, *, sync: bool = False) -> None:
        """Write all pending bytes.

        Raises:
            OSError: The disk rejects them, or the file was deleted, renamed or truncated (ESTALE);
                they stay pending. Or the disk lost earlier bytes (the kernel reports this at the
                next sync); then every flush fails.
        """
        if self._lost is not None:
            raise self._lost
        sync = sync or self._sync_always
        data = b"".join(self._pending)
        self._pending = [data]
        try:
            self._check_file()
            self._raw.seek(self._written)
            done = 0
            while done < len(data):
                done += self._raw.write(data[done:] if done else data)
            if sync:
                self._sync()
        except OSError as error:
            self.problem = error.strerror or str(error)
            raise
        # Only now: after an error, the next flush writes all pending bytes again.
        self._written += len(data)
        self._synced = self._written if sync else self._synced
        self._drop_pending()
        self.problem = ""

    def _check_file(self) -> None:
        own = os.fstat(self._raw.fileno())
        try:
            same = os.path.samestat(own, os.stat(self._raw.name))  # noqa: PTH116  maybe a descriptor
        except FileNotFoundError:
            same = False
        if not same:
            raise OSError(errno.ESTALE, "the file was deleted or renamed")
        if own.st_size < self._written:  # writing after its end would leave a hole
            raise OSError(errno.ESTALE, "the file was truncated")

    def _sync(self) -> None:
        try:
            os.fsync(self._raw.fileno())
        except OSError as error:
            error.strerror = f"not brought to the disk: {error.strerror}"
            # The kernel reports a failed write-back once, without its position. Pending bytes are
            # written again; earlier ones are no longer in memory.
            if self._written > self._synced:
                self._lost = error
            raise

    def _drop_pending(self) -> None:
        self._pending, self._pending_bytes = [], 0

    def clear(self) -> None:
        """Empty the file."""
        self._raw.truncate(0)
        self._written = self._synced = 0
        self._drop_pending()

    def abandon(self) -> None:
        """Close the file after the last complete :meth:`flush`."""
        with suppress(OSError):  # recovery handles a truncated chunk
            if os.fstat(self._raw.fileno()).st_size > self._written:
                self._raw.truncate(self._written)
        with suppress(OSError):
            self._raw.close()

    def close(self) -> None:
        """Close the file; pending bytes are dropped."""
        self._raw.close()


class OutputFile:
    """A recording's file, claimed before the start, and released if the run never starts.

    An existing file keeps its content until :meth:`begin`.

    Raises:
        FileExistsError: It exists and ``overwrite`` is False.
        OSError: It cannot be written, is not a recording, or another run is recording to it.
    """

    def __init__(self, path: Path, *, overwrite: bool, sync: bool = False) -> None:
        self._path = path
        self._ours = not path.exists()
        if overwrite and not self._ours and not path.is_file():
            raise OSError(errno.EINVAL, "Not a regular file", str(path))
        if overwrite and not self._ours and not begins_as_recording(path):
            text = "Not a recording, and --overwrite replaces nothing else: name another file"
            raise OSError(errno.EINVAL, text, str(path))
        # Not "wb": an existing file is emptied when the run starts, under the lock.
        raw = path.open("r+b" if overwrite and not self._ours else "xb", buffering=0)
        lock(raw)
        self.stream = PendingFile(raw, sync=sync)

    def begin(self) -> PendingFile:
        """Empty the file and return it."""
        self.stream.clear()
        return self.stream

    def give_back(self) -> None:
        """Close the file unwritten; remove it unless it existed before."""
        with suppress(OSError):
            self.stream.close()
        if self._ours:
            self._path.unlink(missing_ok=True)
