"""Runs on this machine: where each keeps its ring, who holds which device, and who has died.

Each run has a folder in memory, owned by its user alone. Locks, not process numbers, say who lives:
the kernel drops them with the process that held them. The loop inherits the run's and the device's
locks, so that both stay held until the output is safe, whatever becomes of the supervisor.

A device's lock is a name of an abstract Unix socket: it holds against every user of the machine
(of one network namespace), and there is no file of it that one user could put in another's way.
"""

import errno
import hashlib
import json
import os
import shutil
import socket
import struct
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Self

from hilctl.base.errors import InputError, RunError
from hilctl.base.locks import is_locked, take_lock
from hilctl.base.private import private_folder, user_folders

_CARD = "run.json"
_KEPT = "kept"
_PEER = struct.Struct("3i")  # process, user and group, as in unix(7)
_REFUSED_ONES = 1000  # so many may ask a lock's socket who holds it


@dataclass(frozen=True, slots=True)
class RunCard:
    """What a run says of itself to others.

    Attributes:
        name: Its folder's name, unique among runs of a user.
        experiment: Name of the experiment.
        recording: Absolute path of the recording.
        supervisor: Process number of the supervisor.
        started: Unix time in s.
        holds: What its device holds alone, as :attr:`hilctl.base.device.DeviceInfo.holds`.
    """

    name: str
    experiment: str
    recording: str
    supervisor: int
    started: float
    holds: tuple[str, ...] = ()

    @classmethod
    def from_json(cls, text: str) -> Self:
        """Undo the JSON of the fields."""
        fields = json.loads(text)
        return cls(**{**fields, "holds": tuple(fields.get("holds", ()))})


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
    def description(self) -> Path:
        """File of what the run says of itself to those who look on."""
        return self.path / "description.json"

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

    def keep(self) -> None:
        """Let the folder outlive its supervisor: a guardian is active, or the ring holds samples."""
        (self.path / _KEPT).touch()

    @property
    def kept(self) -> bool:
        """Whether the folder is to outlive its supervisor."""
        return (self.path / _KEPT).exists()

    def remove(self) -> None:
        """Remove it and all that is in it."""
        # The card first: whoever looks in between must not take what is left for a dead run.
        (self.path / _CARD).unlink(missing_ok=True)
        shutil.rmtree(self.path, ignore_errors=True)


def base_folder() -> Path:
    """Return the folder that this user's runs have their folders in.

    ``HILCTL_RUNS`` names another one.

    Raises:
        RunError: There is none that can be used and is this user's alone.
    """
    return _base_folders(make=True)[0]


def _base_folders(*, make: bool) -> list[Path]:
    """Return the folders that runs of this user may be in; the first one made where there is none.

    All of them: where somebody takes the first place, or leaves it, running runs are found still.
    """
    found: list[Path] = []
    problems: list[str] = []
    given = os.environ.get("HILCTL_RUNS")
    try:
        places = [Path(given)] if given else user_folders()
    except OSError as error:
        raise RunError(f"no folder for runs: {error.strerror}") from None
    for place in places:
        try:
            found.append(private_folder(place, make=make and not found))
        except OSError as error:
            if make or _is_own(place):  # where somebody else's stands, no run of ours can be
                problems.append(f"{place}: {error.strerror}")
    if problems and not found:
        hint = "remove it, or name another one by HILCTL_RUNS"
        raise RunError(f"no folder for runs: {'; '.join(problems)} ({hint})")
    return found


def _is_own(path: Path) -> bool:
    with suppress(OSError):
        return path.lstat().st_uid == os.geteuid()
    return False


def runs() -> list[RunFolder]:
    """Return all runs of this user, the oldest first, dead ones included.

    Raises:
        RunError: The folder of this user's runs can't be trusted.
    """
    found = []
    for folder in (each for base in _base_folders(make=False) for each in sorted(base.iterdir())):
        with suppress(OSError, ValueError, TypeError):  # being made or removed at this moment
            card = RunCard.from_json((folder / _CARD).read_text(encoding="utf-8"))
            found.append(RunFolder(folder, card))
    return sorted(found, key=lambda run: run.card.started)


@contextmanager
def run_folder(
    experiment: str, recording: Path, started: float, holds: Sequence[str] = ()
) -> Iterator[tuple[RunFolder, list[int]]]:
    """Make a run's folder and hold its locks; remove it in the end unless it is to be kept.

    Yields:
        The folder, and descriptors of the locks that the loop is to inherit.

    Raises:
        RunError: It can't be made.
    """
    base, number = base_folder(), os.getpid()
    recorded = str(recording.resolve())  # it fails where the working folder is gone
    with ExitStack() as stack:
        try:
            path = _new_folder(base / f"{experiment}-{number}")
            card = RunCard(path.name, experiment, recorded, number, started, tuple(holds))
            folder = RunFolder(path, card)
            stack.callback(_clear_away, folder)
            shared = stack.enter_context(_locked(path / "run.lock"))
            stack.enter_context(_locked(path / "supervisor.lock"))
            # Under the locks: a folder with a card and without locks is a dead run to others.
            stack.callback(_clear_away, folder)
            (path / _CARD).write_text(json.dumps(asdict(card)), encoding="utf-8")
        except OSError as error:
            raise RunError(f"{base}: no run's folder can be made: {error.strerror}") from None
        yield folder, [shared]


def _clear_away(folder: RunFolder) -> None:
    if not folder.kept:
        folder.remove()


def _new_folder(path: Path) -> Path:
    """Make a folder; one of that name may hold the samples of a process of the same number."""
    number, made = 1, path
    while True:
        try:
            made.mkdir(mode=0o700)
            return made
        except FileExistsError:
            number += 1
            made = path.with_name(f"{path.name}-{number}")


@contextmanager
def held_devices(holds: Sequence[str]) -> Iterator[list[int]]:
    """Hold what a device holds alone, against every other run on this machine.

    Args:
        holds: Names, as :attr:`hilctl.base.device.DeviceInfo.holds`.

    Yields:
        Descriptors of the locks, for the loop to inherit.

    Raises:
        InputError: Another run holds one of them; the message names it.
        RunError: The kernel refuses a lock.
    """
    with ExitStack() as stack:
        # In one order for all: else two runs might each get one of two, and both be refused.
        yield [stack.enter_context(_held(name)) for name in sorted(set(holds))]


@contextmanager
def _held(name: str) -> Iterator[int]:
    try:
        lock = socket.socket(socket.AF_UNIX)
    except OSError as error:
        raise RunError(f"{name}: can't be locked: {error.strerror}") from None
    with lock:
        try:
            lock.bind(_lock_address(name))
            lock.listen(_REFUSED_ONES)
        except OSError as error:
            if error.errno != errno.EADDRINUSE:
                raise RunError(f"{name}: can't be locked: {error.strerror}") from None
            raise InputError(
                f"{name} is in use by {_holder(name)}: wait for its end, or stop it first"
            ) from None
        yield lock.fileno()


def _lock_address(name: str) -> bytes:
    """Return the abstract address that stands for a name of any length."""
    return b"\0hilctl/device/" + hashlib.sha256(os.fsencode(name)).hexdigest().encode()


def _holder(name: str) -> str:
    """Say who holds a lock, by what the kernel knows of its socket."""
    with socket.socket(socket.AF_UNIX) as asking:
        asking.setblocking(False)  # it never answers; the kernel does
        try:
            asking.connect(_lock_address(name))
            peer = asking.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, _PEER.size)
        except OSError:  # let go of at this moment, or asked for by too many
            return "another run"
    process, user, _ = _PEER.unpack(peer)
    for run in runs():
        if run.card.supervisor == process:
            return f"run {run.card.experiment} (process {process}, recording {run.card.recording})"
    import pwd

    try:
        return f"process {process} of {pwd.getpwuid(user).pw_name}"
    except KeyError:
        return f"process {process} of user {user}"


@contextmanager
def _locked(path: Path) -> Iterator[int]:
    descriptor = os.open(path, os.O_RDWR | os.O_CREAT, 0o600)
    try:
        take_lock(descriptor)
        yield descriptor
    finally:
        os.close(descriptor)


@contextmanager
def locked_run(run: RunFolder) -> Iterator[int]:
    """Hold the lock of a run whose processes have ended; yield its descriptor.

    Raises:
        BlockingIOError: One of them lives.
    """
    with _locked(run.path / "run.lock") as descriptor:
        yield descriptor


@contextmanager
def taken_over(run: RunFolder) -> Iterator[bool]:
    """Hold the lock of a run whose processes are dead.

    Yields:
        Whether it is held: False where one of them lives, or somebody else was first.
    """
    try:
        descriptor = os.open(run.path / "run.lock", os.O_RDWR)
    except FileNotFoundError:
        yield False
        return
    try:
        take_lock(descriptor)
        # Under the lock: who had it before may have removed what there was.
        held = (run.path / _CARD).exists()
    except BlockingIOError:
        held = False
    try:
        yield held
    finally:
        os.close(descriptor)


def _is_locked(path: Path) -> bool:
    try:
        descriptor = os.open(path, os.O_RDWR)
    except FileNotFoundError:
        return False
    try:
        return is_locked(descriptor)
    finally:
        os.close(descriptor)


def facts_of(run: RunFolder) -> dict[str, Any]:
    """Return a run's card as plain values."""
    return asdict(run.card)
