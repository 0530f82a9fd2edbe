"""Folder of a study: its lock, its recordings, and repair of truncated ones."""

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from mcap.writer import MCAP0_MAGIC

from hilctl.analysis.contour import axis_names
from hilctl.base.errors import DataError, InputError
from hilctl.base.files import exists, reason
from hilctl.base.private_dirs import HAS_LOCKS, take_lock
from hilctl.recording.metadata_keys import AXIS_FACT
from hilctl.recording.recording_files import is_being_recorded
from hilctl.recording.recover import recover_recording
from hilctl.recording.run_summary import read_ends, recordings_in
from hilctl.run.recovery import recover_dead_runs
from hilctl.run.run_folder import runs
from hilctl.run.start import RunKey, completed_key

_LONGEST_WAIT_S = 60.0
_POLL_S = 0.1


@contextmanager
def prepared(
    folder: Path, sleep_s: Callable[[float], None], on_note: Callable[[str], None]
) -> Iterator[None]:
    """Create and lock a study's folder, unless another writes to it, and repair recordings."""
    with locked_folder(folder, sleep_s):
        await_runs(folder, sleep_s)
        for orphan in recover_dead_runs():
            on_note(f"{orphan.name}: recording was incomplete: {orphan.text}")
        for text in repair_recordings(folder):
            on_note(text)
        yield


@contextmanager
def locked_folder(
    folder: Path, sleep_s: Callable[[float], None], wait_s: float = 5.0
) -> Iterator[None]:
    """Create and lock a study's folder; raise InputError if another study uses it."""
    made = [each for each in (folder, *folder.parents) if not exists(each)]
    try:
        folder.mkdir(parents=True, exist_ok=True)
        # Windows has no locks and cannot open a folder.
        held = os.open(folder if HAS_LOCKS else os.devnull, os.O_RDONLY)
    except OSError as error:
        raise InputError(f"{folder}: cannot be created: {error.strerror}") from None
    try:
        waited_s = 0.0
        while not _locked(held):
            if waited_s >= wait_s:
                raise InputError(f"{folder}: another study is writing to it")
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
    """Repair truncated recordings; return one line per repaired file, or raise InputError.

    A file of a run that never started has no samples: an empty file is deleted, and one with an
    incomplete header is kept as ``NAME.torn``.
    """
    done = []
    for path in recordings_in(folder):
        try:
            if read_ends(path).state in {"unfinished", "damaged"}:
                done.append(f"{path}: {recover_recording(path).reason}")
        except DataError:
            try:
                done += _put_aside(path)
            except OSError as error:
                raise InputError(f"{path}: cannot be repaired: {reason(error)}") from None
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


def completed_runs(folder: Path) -> dict[tuple[RunKey, ...], list[tuple[Path, ...]]]:
    """Return the recordings of completed runs in a folder, sorted by name, of all axes of each."""
    found: dict[tuple[RunKey, ...], list[tuple[Path, ...]]] = {}
    axes: dict[str, dict[str, tuple[RunKey, Path]]] = {}
    for path in recordings_in(folder):
        if (key := completed_key(path)) is None:
            continue
        run = read_ends(path).run
        names = axis_names(run) or [""]
        there = axes.setdefault(run.get("run_id", "") if run.get(AXIS_FACT) else str(path), {})
        there[run.get(AXIS_FACT, "")] = key, path
        if all(name in there for name in names):
            keys, paths = zip(*(there.pop(name) for name in names), strict=True)
            found.setdefault(keys, []).append(paths)
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
