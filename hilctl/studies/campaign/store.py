"""Campaign folder: its lock, its recordings, and repair of truncated ones."""

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from mcap.writer import MCAP0_MAGIC

from hilctl.base.errors import DataError, InputError
from hilctl.base.private_dirs import HAS_LOCKS, take_lock
from hilctl.experiment.file import RecordingConfig
from hilctl.experiment.load import document_with
from hilctl.recording.recording_files import is_being_recorded
from hilctl.recording.recover import recover_recording
from hilctl.recording.run_summary import read_ends, recordings_in
from hilctl.run.run_folder import runs
from hilctl.run.start import RunKey, completed_key
from hilctl.studies.campaign.steps import CampaignSteps, settings_of

_LONGEST_WAIT_S = 60.0
_POLL_S = 0.1


def campaign_folder(campaign: CampaignSteps) -> Path:
    """Return the folder from the campaign's file, or one named after the campaign."""
    config = campaign.config
    if config.folder is not None:
        return Path(config.folder)
    with campaign.base_read():
        settings = (*campaign.settings, *settings_of(config.set))
        document = document_with(campaign.experiment, settings)
    given = document.value(("recording", "folder"))
    return Path(given if isinstance(given, str) else RecordingConfig().folder) / config.name


@contextmanager
def locked_folder(
    folder: Path, sleep_s: Callable[[float], None], wait_s: float = 5.0
) -> Iterator[None]:
    """Create and lock a campaign's folder; raise InputError if another campaign uses it."""
    made = [each for each in (folder, *folder.parents) if not each.exists()]
    try:
        folder.mkdir(parents=True, exist_ok=True)
        # Windows has no locks and cannot open a folder.
        held = os.open(folder if HAS_LOCKS else os.devnull, os.O_RDONLY)
    except OSError as error:
        raise InputError(f"{folder}: can't be created: {error.strerror}") from None
    try:
        waited_s = 0.0
        while not _locked(held):
            if waited_s >= wait_s:
                raise InputError(f"{folder}: another campaign is writing to it")
            sleep_s(_POLL_S)
            waited_s += _POLL_S
        try:
            yield
        except InputError:  # nothing was written: remove the new folders
            for each in made:
                with suppress(OSError):  # not empty
                    each.rmdir()
            raise
    finally:
        os.close(held)


def _locked(held: int) -> bool:
    try:
        take_lock(held)
    except BlockingIOError:
        return False
    return True


def await_runs(folder: Path, sleep_s: Callable[[float], None]) -> None:
    """Wait for runs that record to a folder and whose supervisor has died.

    Their loop ends by its safe ramp when it misses the supervisor's heartbeat. Raise InputError if
    a run does not end.
    """
    waited_s, whole = 0.0, folder.resolve()
    while living := [
        run for run in runs() if run.alive and Path(run.card.recording).parent == whole
    ]:
        if living[0].supervised or waited_s > _LONGEST_WAIT_S:
            run = living[0].card
            raise InputError(
                f"{folder}: run {run.name} records to this folder. Wait for its end, or stop it"
            )
        sleep_s(_POLL_S)
        waited_s += _POLL_S


def repair_recordings(folder: Path) -> list[str]:
    """Repair truncated recordings; return one line per repaired file.

    A file of a run that never started has no samples: an empty file is deleted, and one with an
    incomplete header is kept as ``NAME.torn``.
    """
    done = []
    for path in recordings_in(folder):
        try:
            if read_ends(path).state in {"unfinished", "damaged"}:
                done.append(f"{path}: {recover_recording(path).reason}")
        except DataError:
            done += _put_aside(path)
    return done


def _put_aside(path: Path) -> list[str]:
    """Remove or rename a file of a run that never started."""
    with path.open("rb") as stream:
        head = stream.read(len(MCAP0_MAGIC))
        if is_being_recorded(stream) or head not in {b"", MCAP0_MAGIC}:
            return []
    if not head:
        path.unlink()
        return [f"{path}: empty file of a run that never started; deleted"]
    torn = path.rename(f"{path}.torn")
    return [f"{path}: run never started; kept as {torn.name}"]


def completed_runs(folder: Path) -> dict[RunKey, list[Path]]:
    """Return the recordings of completed runs in a folder, sorted by name."""
    found: dict[RunKey, list[Path]] = {}
    for path in recordings_in(folder):
        key = completed_key(path)
        if key is not None:
            found.setdefault(key, []).append(path)
    return found


def last_started(folder: Path) -> Path | None:
    """Return the recording in a folder that started last; None without any."""
    begun = []
    for path in recordings_in(folder):
        try:
            begun.append((read_ends(path).run.get("started", ""), path))
        except DataError:
            continue
    return max(begun)[1] if begun else None


def new_recording(folder: Path, name: str, number: int) -> Path:
    """Return an unused name: ``NAME-0001.mcap``, then ``NAME-0001-2.mcap``."""
    path, attempt = folder / f"{name}-{number:04d}.mcap", 1
    while os.path.lexists(path):
        attempt += 1
        path = folder / f"{name}-{number:04d}-{attempt}.mcap"
    return path
