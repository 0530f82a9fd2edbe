"""The recording side of a run: claims the file, writes batches, survives a full disk."""

from collections.abc import Callable, Mapping
from contextlib import suppress
from datetime import UTC, datetime
from functools import partial
from pathlib import Path

from hilctl.errors import InputError
from hilctl.facts import run_facts
from hilctl.models.files import dump_model
from hilctl.preflight import Checked
from hilctl.recording.data import Event
from hilctl.recording.writer import OutputFile, RecordingWriter, RunFacts
from hilctl.ring import Batch


class Recorder:
    """Records one run into one file.

    A write that fails ends the recording, not the draining: what comes after is counted as lost.

    Args:
        checked: The experiment.
        path: File to record to.
        overwrite: Whether an existing file may be replaced.

    Raises:
        InputError: The file exists or can't be written.
    """

    def __init__(self, checked: Checked, path: Path, *, overwrite: bool) -> None:
        self.path = path
        self.error = ""
        self.lost = 0
        self._checked = checked
        self._writer: RecordingWriter | None = None
        try:
            self._file = OutputFile(path, overwrite=overwrite)
        except FileExistsError:
            raise InputError(
                f"{path}: exists already: give another --output, or --overwrite"
            ) from None
        except OSError as error:
            raise self._unwritable(error) from None

    def _unwritable(self, error: OSError) -> InputError:
        return InputError(f"{self.path}: can't be written: {error.strerror}")

    def begin(self, start_unix_ns: int) -> None:
        """Write what is known before the first sample.

        Raises:
            InputError: The file can't be written.
        """
        try:
            self._writer = RecordingWriter(
                self._file.begin(), self._facts(start_unix_ns), start_unix_ns
            )
        except OSError as error:
            raise self._unwritable(error) from None

    def give_back(self) -> None:
        """Leave no file behind where there was none: the run does not start."""
        self._file.give_back()

    def batch(self, batch: Batch) -> None:
        """Write a batch, or count it as lost where the file can't be written any more."""
        if self.error:
            self.lost += batch.flags.size
        self._write(partial(self._begun.batch, batch))

    def flush(self) -> None:
        """Hand all that was written to the kernel."""
        self._write(self._begun.flush)

    def finish(self, end: Mapping[str, str], ended_at: int) -> None:
        """Write how the run ended, and close the file.

        Args:
            end: Facts of the end, with ``code`` and ``reason``.
            ended_at: Index after the last sample.
        """
        now_ns = int(datetime.now(UTC).timestamp() * 1e9)
        level = "info" if end["code"] == "completed" else "error"
        event = Event(now_ns, max(0, ended_at - 1), level, "run_ended", end["reason"])
        self._write(partial(self._begun.event, event))
        self._write(partial(self._begun.finish, {**end, "ended": iso_time(now_ns)}, ended_at))
        if self.error:
            with suppress(OSError):  # the disk's refusal is known already
                self._file.stream.close()
        self._write(self._file.stream.close)

    @property
    def samples(self) -> int:
        """Samples written."""
        return self._begun.samples

    @property
    def missing(self) -> int:
        """Samples known to be missing: counted in the recording, or lost after it ended."""
        return self._begun.missing + self.lost

    @property
    def _begun(self) -> RecordingWriter:
        assert self._writer is not None
        return self._writer

    def _write(self, write: Callable[[], None]) -> None:
        if self.error:
            return
        try:
            write()
        except OSError as error:
            self.error = f"{self.path}: can't be written: {error.strerror}"

    def _facts(self, start_unix_ns: int) -> RunFacts:
        loaded = self._checked.loaded
        config, info = loaded.config, loaded.device.info
        return RunFacts(
            facts=run_facts(self._checked, iso_time(start_unix_ns)),
            segments=self._checked.reference.segments,
            experiment_yaml=loaded.yaml_text,
            model_yaml=dump_model(loaded.model) if loaded.model else "",
            sample_rate_hz=config.sample_rate_hz,
            command_unit=info.command_unit,
            measures_command=info.measures_command,
            scope_rate_hz=config.recording.scope_rate_hz,
        )


def iso_time(unix_ns: int) -> str:
    """Return a Unix time in ns as ISO 8601, UTC."""
    return datetime.fromtimestamp(unix_ns * 1e-9, tz=UTC).isoformat(timespec="milliseconds")
