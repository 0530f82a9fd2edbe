"""A campaign's folder: the recordings in it, made whole, and who works on it."""

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from mcap.writer import MCAP0_MAGIC

from hilctl.base.errors import ConfigError, DataError, InputError
from hilctl.base.private_dirs import HAS_LOCKS, take_lock
from hilctl.base.yaml import load_document
from hilctl.experiment.sections import RecordingConfig
from hilctl.recording.recording_files import is_being_recorded
from hilctl.recording.recover import recover_recording
from hilctl.recording.run_summary import read_ends, recordings_in
from hilctl.run.run_folder import RunFolder, runs
from hilctl.run.start import RunKey, completed_key
from hilctl.studies.campaign.steps import CampaignSteps, base_problem, settings_of

_LONGEST_WAIT_S = 60.0
_POLL_S = 0.1


def campaign_folder(campaign: CampaignSteps) -> Path:
    """Return the folder of a campaign that is given no other: as its file says, or by its name.

    Raises:
        ConfigError: The base experiment can't be read, or breaks rules.
    """
    config = campaign.config
    if config.folder is not None:
        return Path(config.folder)
    try:
        document = load_document(campaign.experiment)
        for text in (*campaign.settings, *settings_of(config.set)):
            document.set(text)
    except ConfigError:
        raise
    except InputError as error:
        raise base_problem(campaign, error) from None
    recording = document.data.get("recording")
    given = recording.get("folder") if isinstance(recording, dict) else None
    return Path(given if isinstance(given, str) else RecordingConfig().folder) / config.name


@contextmanager
def held_folder(
    folder: Path, sleep_s: Callable[[float], None], wait_s: float = 5.0
) -> Iterator[None]:
    """Make a campaign's folder, and hold it against every other campaign.

    Args:
        folder: The folder.
        sleep_s: Waits that long.
        wait_s: How long to wait for one that is just ending.

    Raises:
        InputError: It can't be made, or another campaign works on it.
    """
    made = [each for each in (folder, *folder.parents) if not each.exists()]
    try:
        folder.mkdir(parents=True, exist_ok=True)
        # Windows opens no folder and has no locks: there is nothing to hold.
        held = os.open(folder if HAS_LOCKS else os.devnull, os.O_RDONLY)
    except OSError as error:
        raise InputError(f"{folder}: can't be made: {error.strerror}") from None
    try:
        waited_s = 0.0
        while not _locked(held):
            if waited_s >= wait_s:
                raise InputError(f"{folder}: another campaign is writing to it")
            sleep_s(_POLL_S)
            waited_s += _POLL_S
        try:
            yield
        except InputError:  # nothing has been written: the folders are not left behind either
            for each in made:
                with suppress(OSError):  # something stands in it, which is somebody's
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
    """Wait for the end of runs that record to a folder: of one whose supervisor was killed.

    Its loop goes on until it misses the supervisor, and leaves by its safe ramp.

    Raises:
        InputError: One does not end.
    """
    waited_s = 0.0
    while living := [run for run in runs() if run.alive and _is_in(run, folder)]:
        if living[0].supervised or waited_s > _LONGEST_WAIT_S:
            run = living[0].card
            raise InputError(
                f"{folder}: run {run.name} records to it: wait for its end, or stop it"
            )
        sleep_s(_POLL_S)
        waited_s += _POLL_S


def _is_in(run: RunFolder, folder: Path) -> bool:
    return Path(run.card.recording).parent == folder.resolve()


def make_whole(folder: Path) -> list[str]:
    """Make recordings whole that were cut short; return what was done, for people.

    What was killed before its run began holds nothing of one: an empty file is removed, and one
    with less than a head is kept as ``NAME.torn``.
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
    """Take a file out of the way that was claimed for a run that never began."""
    with path.open("rb") as stream:
        head = stream.read(len(MCAP0_MAGIC))
        if is_being_recorded(stream) or head not in {b"", MCAP0_MAGIC}:
            return []
    if not head:
        path.unlink()
        return [f"{path}: its run never began; the empty file is removed"]
    torn = path.rename(f"{path}.torn")
    return [f"{path}: its run never began; what there is is kept as {torn.name}"]


def standing_runs(folder: Path) -> dict[RunKey, list[Path]]:
    """Return the completed runs whose recordings are in a folder, in the order of their names."""
    found: dict[RunKey, list[Path]] = {}
    for path in recordings_in(folder):
        key = completed_key(path)
        if key is not None:
            found.setdefault(key, []).append(path)
    return found


def last_begun(folder: Path) -> Path | None:
    """Return the recording in a folder whose run began last; None without any."""
    begun = []
    for path in recordings_in(folder):
        try:
            begun.append((read_ends(path).run.get("started", ""), path))
        except DataError:
            continue
    return max(begun)[1] if begun else None


def new_recording(folder: Path, name: str, number: int) -> Path:
    """Return a name that no file has: ``NAME-0001.mcap``, and ``NAME-0001-2.mcap`` after that."""
    path, attempt = folder / f"{name}-{number:04d}.mcap", 1
    while os.path.lexists(path):
        attempt += 1
        path = folder / f"{name}-{number:04d}-{attempt}.mcap"
    return path
