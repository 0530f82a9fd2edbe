"""Runs on this machine: where each keeps its ring, who holds which device, and who has died.

Each run has a folder in memory, owned by its user alone. Locks, not process numbers, say who lives:
the kernel drops them with the process that held them. The loop inherits the run's and the device's
locks, so that both stay held until the output is safe, whatever becomes of the supervisor.
"""

import fcntl
import json
import os
import re
import shutil
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from hilctl.base.errors import InputError, RunError
from hilctl.run.ring import memory_folder

_CARD = "run.json"


@dataclass(frozen=True, slots=True)
class RunCard:
    """What a run says of itself to others.

    Attributes:
        name: Its folder's name, unique among runs of a user.
        experiment: Name of the experiment.
        recording: Absolute path of the recording.
        supervisor: Process number of the supervisor.
        started: Unix time in s.
    """

    name: str
    experiment: str
    recording: str
    supervisor: int
    started: float


@dataclass(frozen=True, slots=True)
class RunFolder:
    """A run's folder.

    Attributes:
        path: The folder.
        card: What stands in it of the run.
    """

    path: Path
    card: RunCard

    @property
    def ring(self) -> Path:
        """File of the ring."""
        return self.path / "ring"

    @property
    def reference(self) -> Path:
        """File of the reference samples."""
        return self.path / "reference.npy"

    @property
    def input_um(self) -> Path:
        """File of the compensator's input, where it is not the reference."""
        return self.path / "input_um.npy"

    @property
    def guardian_job(self) -> Path:
        """File of what the guardian is to guard."""
        return self.path / "guardian.json"

    @property
    def socket(self) -> Path:
        """Socket that the supervisor answers at."""
        return self.path / "socket"

    @property
    def supervised(self) -> bool:
        """Whether the supervisor lives."""
        return _is_locked(self.path / "supervisor.lock")

    @property
    def alive(self) -> bool:
        """Whether supervisor or loop lives."""
        return _is_locked(self.path / "run.lock")

    def remove(self) -> None:
        """Remove it and all that is in it."""
        shutil.rmtree(self.path, ignore_errors=True)


def base_folder() -> Path:
    """Return the folder that this user's runs have their folders in.

    ``HILCTL_RUNS`` names another one.

    Raises:
        RunError: It can't be used, or belongs to somebody else.
    """
    given = os.environ.get("HILCTL_RUNS")
    folder = Path(given) if given else memory_folder() / f"hilctl-{os.getuid()}"
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        found = folder.lstat()  # a link that somebody else has put there is not ours to follow
    except OSError as error:
        raise RunError(f"{folder}: can't be made: {error.strerror}") from None
    if found.st_uid != os.getuid() or found.st_mode & 0o022:
        raise RunError(f"{folder}: must be yours, and writable by nobody else: remove it")
    return folder


def runs() -> list[RunFolder]:
    """Return all runs of this user, the oldest first, dead ones included."""
    found = []
    for folder in sorted(base_folder().iterdir()):
        with suppress(OSError, ValueError, TypeError):  # being made or removed at this moment
            card = RunCard(**json.loads((folder / _CARD).read_text(encoding="utf-8")))
            found.append(RunFolder(folder, card))
    return sorted(found, key=lambda run: run.card.started)


@contextmanager
def run_folder(
    experiment: str, recording: Path, started: float
) -> Iterator[tuple[RunFolder, list[int]]]:
    """Make a run's folder and hold its locks; remove it in the end.

    Yields:
        The folder, and descriptors of the locks that the loop is to inherit.

    Raises:
        RunError: It can't be made.
    """
    number = os.getpid()
    path = base_folder() / f"{experiment}-{number}"
    card = RunCard(path.name, experiment, str(recording.resolve()), number, started)
    shutil.rmtree(path, ignore_errors=True)  # of a dead process that had the same number
    path.mkdir(mode=0o700)
    with ExitStack() as stack:
        stack.callback(shutil.rmtree, path, ignore_errors=True)
        shared = stack.enter_context(_locked(path / "run.lock"))
        stack.enter_context(_locked(path / "supervisor.lock"))
        # After the locks: others know a run by its card, and take one without locks for dead.
        (path / _CARD).write_text(json.dumps(asdict(card)), encoding="utf-8")
        yield RunFolder(path, card), [shared]


@contextmanager
def held_devices(holds: Sequence[str], user: str) -> Iterator[list[int]]:
    """Hold what a device holds alone, against every other run on this machine.

    Args:
        holds: Names, as :attr:`hilctl.base.device.DeviceInfo.holds`.
        user: Who holds it, for the message that the next one gets.

    Yields:
        Descriptors of the locks, for the loop to inherit.

    Raises:
        InputError: Another run holds one of them; the message names it.
    """
    folder = memory_folder() / "hilctl-devices"
    with suppress(FileExistsError):
        folder.mkdir()
        folder.chmod(0o1777)  # the umask cuts the mode that mkdir is given
    with ExitStack() as stack:
        descriptors = []
        # In one order for all: else two runs might each get one of two, and both be refused.
        for name in sorted(set(holds)):
            path = folder / (re.sub(r"[^A-Za-z0-9.:_-]+", "_", name) + ".lock")
            descriptors.append(stack.enter_context(_held(path, name, user)))
        yield descriptors


@contextmanager
def _held(path: Path, name: str, user: str) -> Iterator[int]:
    descriptor = _open_shared(path)
    try:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            holder = os.pread(descriptor, 1000, 0).decode(errors="replace") or "another run"
            raise InputError(
                f"{name} is in use by {holder}: wait for its end, or stop it first"
            ) from None
        with suppress(OSError):  # a lock file of another user: who holds it can't be written down
            os.ftruncate(descriptor, 0)
            os.pwrite(descriptor, user.encode(), 0)
        yield descriptor
    finally:
        os.close(descriptor)


def _open_shared(path: Path) -> int:
    """Open a lock file that every user of the machine may lock."""
    try:
        # Without O_CREAT first: in a sticky folder Linux may refuse it on another user's file.
        return os.open(path, os.O_RDWR)
    except PermissionError:
        return os.open(path, os.O_RDONLY)
    except FileNotFoundError:
        return os.open(path, os.O_RDWR | os.O_CREAT, 0o644)


@contextmanager
def _locked(path: Path) -> Iterator[int]:
    descriptor = os.open(path, os.O_RDWR | os.O_CREAT, 0o600)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        yield descriptor
    finally:
        os.close(descriptor)


@contextmanager
def taken_over(run: RunFolder) -> Iterator[bool]:
    """Hold the lock of a run whose processes are dead.

    Yields:
        Whether it is held: False where one of them lives, or somebody else was first.
    """
    try:
        descriptor = os.open(run.path / "run.lock", os.O_RDWR)
    except OSError:
        yield False
        return
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        held = run.path.exists()  # under the lock: who had it before may have removed the folder
    except BlockingIOError:
        held = False
    try:
        yield held
    finally:
        os.close(descriptor)


def _is_locked(path: Path) -> bool:
    try:
        descriptor = os.open(path, os.O_RDWR)
    except OSError:
        return False
    try:
        # Shared: two that look at once must not take each other for the holder.
        fcntl.flock(descriptor, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    finally:
        os.close(descriptor)
    return False


def facts_of(run: RunFolder) -> dict[str, Any]:
    """Return a run's card as plain values."""
    return asdict(run.card)
