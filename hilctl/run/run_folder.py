"""Runs on this computer: their folders in memory, and locks of runs and devices.

A lock on the run's card, not a process number, decides whether a run is alive: the kernel releases
it with the last process that holds it. Loop and guardian inherit the locks of run and device, so
both are held until the output is safe, even if the supervisor dies.

systemd-logind removes the folder of an active run when its user logs out (RemoveIPC). The files
stay open in the processes of the run, and are found through ``/proc``.

A device has two locks. A file excludes other runs of this user. A bound name of an abstract Unix
socket excludes other users and other folders for runs; any user can bind it, so a run can be told
to ignore a name that another user has bound. The process that holds the locks owns the device.
"""

import hashlib
import json
import logging
import os
import shutil
import socket
import struct
import sys
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import asdict, dataclass, field
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple, Self

from hilctl.base.errors import InputError, RunError
from hilctl.base.private_dirs import (
    is_locked,
    private_folder,
    release_lock,
    take_lock,
    user_folders,
)
from hilctl.machine.procfs import login_of

_log = logging.getLogger(__name__)

WORKS_ANYWHERE = "report, replay, export, identify, compare, check and learn --fast work here"

_CARD = "run.json"
_KEPT = "kept"
_RECORDED = "recorded"
_SUPERVISOR = "supervisor.lock"
_DEVICES = "devices"
_RING = "ring"
_REMOVED = " (deleted)"
_PEER = struct.Struct("3i")  # process, user and group, as in unix(7)
GUARDIAN = "hilctl.run.safety.guardian"
LOOP = "hilctl.run.loop_process"
"""Modules of the processes of a run."""
_IF_OWN = "wait for its end, or stop it first"
_IF_STRANGER = "ask its user to stop it; hilctl run --take-over runs nevertheless"
_BACKLOG = 1000  # connections that query the holder of a device; never accepted


class OutputPlace(NamedTuple):
    """Place of an output, from its :class:`hilctl.base.device.DeviceInfo`."""

    holds: tuple[str, ...]
    output: str

    def is_same(self, other: "OutputPlace") -> bool:
        """Return whether two places are one output; a device may have several names."""
        return self.output == other.output and bool({*self.holds} & {*other.holds})


@dataclass(frozen=True, slots=True)
class RunCard:
    """Identity of a run, for other commands."""

    name: str  # name of its folder, unique among the runs of a user; a process never reuses it
    experiment: str
    recording: str
    supervisor: int
    started: float  # unix time in s
    holds: tuple[str, ...] = ()  # resources of its devices, as DeviceInfo.holds
    axes: Mapping[str, str] = field(default_factory=dict)  # recordings; empty with one axis
    outputs: tuple[OutputPlace, ...] = ()  # of each axis

    @classmethod
    def from_json(cls, text: str) -> Self:
        """Return a card; raise ValueError or TypeError if a text is not one."""
        values = {"holds": [], "outputs": [], **json.loads(text)}
        outputs = tuple(OutputPlace(tuple(holds), name) for holds, name in values["outputs"])
        return cls(**values | {"holds": tuple(values["holds"]), "outputs": outputs})

    @property
    def recordings(self) -> list[Path]:
        """Recordings of all axes, that of the first one first."""
        return [Path(each) for each in [*self.axes.values()] or [self.recording]]


@dataclass(frozen=True, slots=True)
class RunFolder:
    """The folder of a run."""

    path: Path
    card: RunCard

    @property
    def ring(self) -> Path:
        """File of the ring of the first axis, with the page of the run."""
        return self.ring_of(0)

    def ring_of(self, axis: int) -> Path:
        """Return the file of the ring of an axis by its number."""
        return self._file(self.file_of(_RING, axis).name)

    def file_of(self, name: str, axis: int) -> Path:
        """Return the path of a file of an axis by its number."""
        path = self.path / name
        return path.with_stem(f"{path.stem}-{axis}") if axis else path

    def description_of(self, axis: int) -> Path:
        """Return the file of the description of an axis for watchers, by its number."""
        return self._file(self.file_of("description.json", axis).name)

    @property
    def job(self) -> Path:
        """File of the job of the loop process and the guardian."""
        return self.path / "job.json"

    @property
    def guardian_log(self) -> Path:
        """File of the guardian's standard error."""
        return self.path / "guardian.log"

    @property
    def socket(self) -> Path:
        """Control socket of the supervisor."""
        return self.path / "socket"

    @property
    def supervised(self) -> bool:
        """Whether the supervisor is alive."""
        return _is_locked(self._file(_SUPERVISOR))

    @property
    def alive(self) -> bool:
        """Whether a process of the run is alive."""
        return _is_locked(self._file(_CARD))

    @property
    def loops(self) -> bool:
        """Whether the loop process is alive."""
        return self.job in jobs_of(LOOP)

    def keep(self, *, recorded: bool) -> None:
        """Keep the folder after the supervisor, for an output or samples that are not safe yet."""
        # Folders, because a process without free descriptors can create no files.
        for mark in (_RECORDED, _KEPT) if recorded else (_KEPT,):
            (self.path / mark).mkdir(exist_ok=True)

    @property
    def kept(self) -> bool:
        """Whether the folder stays after the supervisor."""
        return (self.path / _KEPT).exists()

    @property
    def recorded(self) -> bool:
        """Whether the recording is complete, and the folder was kept for the output alone."""
        return (self.path / _RECORDED).exists()

    def remove(self) -> None:
        """Remove the folder."""
        # The card first, so that a partly removed folder is not a dead run; emptied, because
        # processes of the run may still have it open.
        with suppress(FileNotFoundError):
            os.truncate(self.path / _CARD, 0)
        (self.path / _CARD).unlink(missing_ok=True)
        shutil.rmtree(self.path, ignore_errors=True)

    def _file(self, name: str) -> Path:
        """Return a file of the folder, or of ``/proc`` if the folder was removed."""
        path = self.path / name
        if path.exists() or (self.path / _CARD).exists():
            return path
        return _removed_files().get(path.resolve(), path)


def base_folder() -> Path:
    """Return the private parent of this user's run folders; ``HILCTL_RUNS`` overrides it."""
    return _base_folders(make=True)[0]


def _places() -> list[Path]:
    """Return all possible parents of this user's run folders."""
    given = os.environ.get("HILCTL_RUNS")
    try:
        return [Path(given)] if given else user_folders()
    except OSError as error:
        raise RunError(f"no folder for runs: {error.strerror}") from None


def _base_folders(*, make: bool) -> list[Path]:
    """Return the existing parents; create the first one if ``make``."""
    found: list[Path] = []
    problems: list[str] = []
    for place in _places():
        try:
            found.append(private_folder(place, make=make and not found))
        except OSError as error:
            if make or _is_own(place):  # a folder of another user holds no run of this one
                problems.append(f"{place}: {error.strerror}")
    if problems and not found:
        hint = "remove it, or set HILCTL_RUNS to another one"
        raise RunError(f"no folder for runs: {'; '.join(problems)} ({hint})")
    return found


def _is_own(path: Path) -> bool:
    with suppress(OSError):
        return hasattr(os, "geteuid") and path.lstat().st_uid == os.geteuid()
    return False


def runs() -> list[RunFolder]:
    """Return all runs of this user, oldest first, dead ones included."""
    cards: dict[Path, Path] = {}
    for base in _base_folders(make=False):
        cards |= {each / _CARD: each / _CARD for each in base.resolve().iterdir()}
    bases = [base.resolve() for base in _places()]
    for card, opened in _removed_files().items():
        if card.name == _CARD and card.parent.parent in bases and not card.exists():
            cards[card] = opened
    found = []
    for path, readable in cards.items():
        with suppress(OSError):  # being created or removed, or not a run's folder
            text = readable.read_text(encoding="utf-8", errors="replace")
            try:
                if text:  # empty after the end of a run
                    found.append(RunFolder(path.parent, RunCard.from_json(text)))
            except (ValueError, TypeError) as error:
                _warn_once(path.parent.name, f"{path}: {error}")
    return sorted(found, key=lambda run: run.card.started)


@cache
def _warn_once(name: str, text: str) -> None:
    _log.warning("%s: ignored; hilctl recover --dismiss %s removes it", text, name)


def _removed_files(process: str = "[0-9]*") -> dict[Path, Path]:
    """Return removed files of this user that processes have open, and their paths in ``/proc``."""
    found: dict[Path, Path] = {}
    if not hasattr(os, "geteuid"):  # Windows has no runs
        return found
    for opened in Path("/proc").glob(f"{process}/fd"):
        with suppress(OSError):  # it has ended, or belongs to another user
            own = opened.stat().st_uid == os.geteuid()
            for link in opened.iterdir() if own else ():
                with suppress(OSError):
                    name = str(link.readlink())
                    if not name.endswith(_REMOVED):
                        continue
                    path, file = Path(name.removesuffix(_REMOVED)), link.stat()
                    # Another user can open files of any name. An empty card belongs to a
                    # run that has ended.
                    if file.st_uid == os.geteuid() and (file.st_size or path.name != _CARD):
                        found.setdefault(path, link)
    return found


def keep_removed() -> None:
    """Restore a removed run folder from the files that this process has open."""
    # A process that outlives its supervisor calls this: the next command recovers the samples.
    own = _removed_files("self")
    for card, opened in own.items():
        folder = card.parent
        rings = [each for each in own if each.parent == folder and each.name.startswith(_RING)]
        if card.name == _CARD and rings and not card.exists():
            with suppress(OSError):  # no process is left to report it to
                private_folder(private_folder(folder.parent) / folder.name)
                for ring in rings:
                    shutil.copyfile(own[ring], ring)
                shutil.copyfile(opened, folder / f"{_CARD}.new")
                # Last: a folder with a card is a dead run, whose rings are whole.
                (folder / f"{_CARD}.new").rename(card)
                os.truncate(opened, 0)  # the run is found once, also until this process has ended


@contextmanager
def run_folder(
    experiment: str,
    recordings: Mapping[str, Path],
    started: float,
    holds: Sequence[str] = (),
    outputs: Sequence[OutputPlace] = (),
) -> Iterator[tuple[RunFolder, list[int]]]:
    """Provide a run's folder and descriptors of its locks; remove it at the end unless kept.

    ``recordings`` are those of the axes by name; that of the only axis has an empty one. See
    :class:`RunCard` for ``holds`` and ``outputs``.
    """
    base, number = base_folder(), os.getpid()
    # Fails if the working folder was removed.
    axes = {axis: str(each.resolve()) for axis, each in recordings.items()}
    recorded = next(iter(axes.values()))
    axes.pop("", None)
    with ExitStack() as stack:
        try:
            path = _new_folder(base / f"{experiment}-{number}")
            devices = tuple(holds), axes, tuple(outputs)
            card = RunCard(path.name, experiment, recorded, number, started, *devices)
            folder = RunFolder(path, card)
            stack.callback(_clear_away, folder)
            unnamed = path / f"{_CARD}.new"
            shared = stack.enter_context(_locked(unnamed))
            stack.enter_context(_locked(path / _SUPERVISOR))
            stack.callback(_clear_away, folder)
            unnamed.write_text(json.dumps(asdict(card)), encoding="utf-8")
            # Under the locks: a card without locks is a dead run to others.
            unnamed.rename(path / _CARD)
        except OSError as error:
            raise RunError(f"{base}: cannot create the folder of a run: {error.strerror}") from None
        yield folder, [shared]


def _clear_away(folder: RunFolder) -> None:
    if not folder.kept:
        folder.remove()


_names: Counter[Path] = Counter()


def _new_folder(path: Path) -> Path:
    """Create a folder whose name no run of this process had: clients may still know that run.

    A kept folder of the same name may exist.
    """
    while True:
        _names[path] += 1
        number = _names[path]
        made = path.with_name(f"{path.name}-{number}") if number > 1 else path
        with suppress(FileExistsError):
            made.mkdir(mode=0o700)
            return made


class DeviceLocks:
    """Locks of a device's resources, opened before they are acquired.

    Processes that inherit the descriptors hold the locks that are acquired later, until they end.

    Args:
        holds: Resources, see :attr:`hilctl.base.device.DeviceInfo.holds`.
        take_over: Whether to ignore other users.
        inherited: The :attr:`descriptors` of the process that acquires the locks.

    Raises:
        RunError: The file of a lock cannot be created.
    """

    def __init__(
        self, holds: Sequence[str], *, take_over: bool = False, inherited: Sequence[int] = ()
    ) -> None:
        self._take_over, self._acquired = take_over, bool(inherited)
        names = sorted(set(holds))
        self._files = dict(zip(names, inherited, strict=False))
        self._names = {
            name: socket.socket(fileno=descriptor)
            for name, descriptor in zip(names, inherited[len(names) :], strict=False)
        }
        if inherited:
            return
        folder = base_folder() / _DEVICES if holds else Path()
        try:
            # In the same order for all runs, so that one of two runs gets all of them.
            for name in names:
                path = private_folder(folder) / f"{_digest(name)}.lock"
                self._files[name] = os.open(path, os.O_RDWR | os.O_CREAT, 0o600)
                self._names[name] = socket.socket(socket.AF_UNIX)
        except OSError as error:
            self.close()
            raise RunError(f"{folder}: {name} cannot be locked: {error.strerror}") from None

    @property
    def descriptors(self) -> list[int]:
        """The descriptors to inherit."""
        return [*self._files.values(), *(each.fileno() for each in self._names.values())]

    def holder(self) -> str:
        """Acquire all locks, or return a resource that another process has.

        No file is locked then. Names that are free stay bound until :meth:`release`.
        """
        if self._acquired:
            return ""
        try:
            for name in self._files:
                take_lock(self._files[name])
            for name, told in self._names.items():
                if not told.getsockname():
                    self._bind(name, told)
        except BlockingIOError:
            for file in self._files.values():
                release_lock(file)
            return name
        self._acquired = True
        return ""

    def acquire(self) -> None:
        """Acquire all locks; raise InputError if another process has one."""
        if not (name := self.holder()):
            return
        holder = _holder(_address(name))
        if _is_trusted(holder):
            raise _in_use(name, holder)
        if is_locked(self._files[name]):  # by this user, who took the device over
            raise _in_use(name, None)
        raise _in_use(name, holder, _IF_STRANGER)

    def release(self) -> None:
        """Release the locks for all processes that share them; they can be acquired again."""
        for file in self._files.values():
            release_lock(file)
        for name, told in self._names.items():
            told.close()
            self._names[name] = socket.socket(socket.AF_UNIX)
        self._acquired = False

    def _bind(self, name: str, told: socket.socket) -> None:
        try:
            told.bind(_address(name))
            told.listen(_BACKLOG)
        except OSError:
            holder = _holder(_address(name))
            if not self._take_over or _is_trusted(holder):
                raise BlockingIOError from None
            text = "%s may be in use by %s as well: only one program must drive a device"
            _log.warning(text, name, _text_of(holder))

    def close(self) -> None:
        """Release the locks, unless processes that inherited them hold them."""
        for file in self._files.values():
            os.close(file)
        for told in self._names.values():
            told.close()
        self._files, self._names = {}, {}

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def _digest(name: str) -> str:
    return hashlib.sha256(os.fsencode(name)).hexdigest()


def _address(name: str) -> bytes:
    return b"\0hilctl/device/" + _digest(name).encode()


def _holder(address: bytes) -> tuple[int, int] | None:
    """Return process and user that have bound an address; None if unknown."""
    with socket.socket(socket.AF_UNIX) as asking:
        asking.setblocking(False)  # the kernel answers
        try:
            asking.connect(address)
            raw = asking.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, _PEER.size)
        except OSError:  # released, not listening, or its queue is full
            return None
    process, user, _ = _PEER.unpack(raw)
    return process, user


def _is_trusted(holder: tuple[int, int] | None) -> bool:
    return holder is not None and holder[1] in {0, os.geteuid()}


def _in_use(name: str, holder: tuple[int, int] | None, hint: str = _IF_OWN) -> InputError:
    if guardian := _guardian_of(name):
        run, folder = guardian.card.name, guardian.path.parent
        every = ", as hilctl safe does for all axes of its experiment" if guardian.card.axes else ""
        hint = (
            f"the guardian of {run} sets its safe value{every}. HILCTL_RUNS={folder} hilctl stop "
            f"--run {run} ends it, and leaves the output as it is"
        )
    return InputError(f"{name} is in use by {_text_of(holder)}: {hint}")


def jobs_of(module: str) -> Iterator[Path]:
    """Yield the job of each live process that runs a module of a run."""
    for command in Path("/proc").glob("[0-9]*/cmdline"):
        with suppress(OSError, ValueError, IndexError):  # it has ended, or is another program
            words = os.fsdecode(command.read_bytes()).split("\0")
            yield Path(words[words.index(module) + 1])


def _guardian_of(name: str) -> RunFolder | None:
    """Return the run whose guardian holds a resource after its supervisor, in any folder."""
    for job in jobs_of(GUARDIAN):
        with suppress(OSError, ValueError, TypeError):
            card = RunCard.from_json((job.parent / _CARD).read_text(encoding="utf-8"))
            if name in card.holds and not (run := RunFolder(job.parent, card)).supervised:
                return run
    return None


def _text_of(holder: tuple[int, int] | None) -> str:
    if holder is None:
        return "another program"
    process, user = holder
    for run in runs():
        if run.card.supervisor == process:
            return f"run {run.card.experiment} (process {process}, recording {run.card.recording})"
    return f"process {process} of {login_of(user) or f'user {user}'}"


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
    """Lock a dead run for its new guardian, and yield the descriptor; raise OSError if alive."""
    with _locked(run.path / _CARD) as descriptor:
        yield descriptor


@contextmanager
def taken_over(run: RunFolder) -> Iterator[bool]:
    """Act for the dead supervisor of a run; yield False if another command acts or has acted."""
    try:
        descriptor = os.open(run.path / _SUPERVISOR, os.O_RDWR | os.O_CREAT, 0o600)
    except FileNotFoundError:
        yield False
        return
    try:
        take_lock(descriptor)
        # Under the lock: another command may have finished the run before.
        held = (run.path / _CARD).exists() and not run.recorded
    except BlockingIOError:
        held = False
    try:
        yield held
    finally:
        os.close(descriptor)


def dismiss(name: str) -> Path:
    """Remove the folder of a dead run with its samples; raise InputError if it is alive."""
    found = [each for base in _base_folders(make=False) for each in base.iterdir()]
    for folder in found:
        if folder.name == name and folder.name != _DEVICES:
            if _is_locked(folder / _CARD):
                raise InputError(f"{name} is active: stop it with hilctl stop --run {name}")
            shutil.rmtree(folder, ignore_errors=True)
            return folder
    known = ", ".join(sorted(each.name for each in found if each.name != _DEVICES))
    raise InputError(f"no run is named {name!r} ({known or 'there is none'})")


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
    card = asdict(run.card)
    return {key: card[key] for key in card if key != "outputs" and (key != "axes" or card[key])}


def require_linux() -> None:
    """Refuse systems other than Linux with an InputError."""
    system = sys.platform
    if system != "linux":
        raise InputError(f"a run needs Linux, this is {system}: {WORKS_ANYWHERE}")
