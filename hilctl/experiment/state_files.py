"""Files with the last run of each output of a device, and the heat of its coil.

Each user has a folder in ``/var/tmp`` that others can only read, and all of these folders are read,
because the actuator is the same for all users. ``XDG_STATE_HOME`` replaces them. A file is written
when a run begins and again when it ends, so a killed run leaves an unknown state and never an older
one.
"""

import hashlib
import json
import logging
import os
import stat
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Annotated, Self

from hilctl.base.device import DeviceInfo
from hilctl.base.errors import InputError
from hilctl.base.files import write_text
from hilctl.base.private_dirs import private_folder
from hilctl.base.strict import Field, StrictModel, ValidationError

_log = logging.getLogger(__name__)

_SHARED = Path("/var/tmp")  # noqa: S108  survives a reboot; only its owner removes a folder
_BOOT_ID = Path("/proc/sys/kernel/random/boot_id")
_MOST_BYTES = 1 << 16
_NUMBERED = "usb:"


@dataclass(frozen=True, slots=True)
class MachineTime:
    """A time by the wall clock, which can be set, and by the time since the boot, which cannot."""

    unix_s: float
    boot_s: float  # since the boot, suspended or not
    boot: str = ""  # identity of the boot; empty if unknown

    @classmethod
    def now(cls) -> Self:
        """Return the present time."""
        try:
            boot = _BOOT_ID.read_text(encoding="ascii").strip()
        except OSError:
            boot = ""
        clock = getattr(time, "CLOCK_BOOTTIME", None)
        boot_s = time.monotonic() if clock is None else time.clock_gettime(clock)
        return cls(time.time(), boot_s, boot)


class CoilState(StrictModel, extra="ignore"):
    """State of the coil after a run."""

    ended: datetime  # end of the run
    output_safe: bool  # whether the device confirmed its safe value
    heat_a2: Annotated[float, Field(ge=0.0)]  # running mean square of its current, in A^2
    thermal_time_constant_s: float | None  # None without a thermal budget


class DeviceState(StrictModel, extra="ignore"):
    """The last run of an output. Keys of newer versions are ignored."""

    holds: Annotated[list[str], Field(min_length=1)]  # names of the device, see DeviceInfo.identity
    output: str = ""  # see DeviceInfo.output
    run_id: str
    recording: str  # absolute path; its commands determine the actuator's state
    started: datetime  # due time of its first sample
    boot: str = ""  # the boot that it ran in; empty if unknown
    boot_s: float = 0.0  # its end, since that boot; the latest possible one until it has ended
    coil: CoilState | None = None  # final state of the coil; None until the run has ended


@dataclass(frozen=True, slots=True)
class LastRun:
    """The last run of an output by one of its files."""

    path: Path
    changed_s: float  # Unix time of the file
    state: DeviceState | None  # None if the file is damaged, or of a newer version

    @property
    def ended_s(self) -> float:
        """End of the run by the wall clock, or its start if the end is unknown."""
        if self.state is None:
            return self.changed_s
        return (self.state.coil.ended if self.state.coil else self.state.started).timestamp()

    def since_s(self, now: MachineTime) -> float:
        """Return the time that has certainly passed since its end.

        Only within one boot is that known. Otherwise the wall clock may have been set, so it
        counts for no more than the present boot has lasted.
        """
        if self._in_boot(now):
            assert self.state is not None
            return max(0.0, now.boot_s - self.state.boot_s)
        return max(0.0, min(now.boot_s, now.unix_s - self.ended_s))

    def order(self, now: MachineTime) -> tuple[bool, float]:
        """Return a key that sorts runs by time."""
        in_boot = self._in_boot(now)
        return in_boot, -self.since_s(now) if in_boot else self.ended_s

    def _in_boot(self, now: MachineTime) -> bool:
        return self.state is not None and bool(now.boot) and self.state.boot == now.boot


def names_of(info: DeviceInfo) -> tuple[str, ...]:
    """Return the names of a device between runs; none if it has no state."""
    return info.identity or info.holds


def last_runs(info: DeviceInfo) -> list[LastRun]:
    """Return the last run of a device's output by the files of each user and name."""
    names, found = names_of(info), []
    keys = {_key(name, info.output) for name in names}
    for path in _files() if names else ():
        state = _read(path)
        if path.stem in keys if state is None else _is_same(state, names, info.output):
            with suppress(OSError):  # removed since
                found.append(LastRun(path, path.lstat().st_mtime, state))
    return found


def write_state(state: DeviceState) -> None:
    """Replace this user's file of an output; if that fails, leave an empty one: unknown."""
    path = None
    try:
        path = _own_folder() / f"{_key(state.holds[0], state.output)}.json"
        write_text(path, state.model_dump_json(), overwrite=True)
        path.chmod(0o644)
    except (InputError, OSError) as error:
        _log.warning("%s: the next run cannot use the final state of this one", error)
        if path is not None:
            with suppress(OSError):
                path.write_bytes(b"")  # needs no room on a full disk


def state_of_run(run_id: str) -> DeviceState | None:
    """Return the state that a run has written; None without one."""
    return next((each for each in map(_read, _files()) if each and each.run_id == run_id), None)


def _is_same(state: DeviceState, names: Sequence[str], output: str) -> bool:
    """Return whether a state is that of an output. Serial numbers decide if both have one."""
    both = [{name for name in each if name.startswith(_NUMBERED)} for each in (state.holds, names)]
    if not all(both):
        both = [set(state.holds), set(names)]
    return not both[0].isdisjoint(both[1]) and state.output in {"", output or state.output}


def _key(name: str, output: str) -> str:
    return hashlib.sha256(json.dumps([name, output]).encode()).hexdigest()[:32]


def _read(path: Path) -> DeviceState | None:
    """Return the content of a file, perhaps of another user; None if it is unusable."""
    try:
        # Follow no link, and wait for no pipe.
        descriptor = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK)
        with os.fdopen(descriptor, "rb") as stream:
            if not stat.S_ISREG(os.fstat(descriptor).st_mode):
                return None
            return DeviceState.model_validate_json(stream.read(_MOST_BYTES))
    except (OSError, ValidationError):
        return None


def _override() -> Path | None:
    given = Path(os.environ.get("XDG_STATE_HOME", ""))
    return given / "hilctl" / "devices" if given.is_absolute() else None


def _folders() -> list[Path]:
    """Return the folders of all users."""
    if (given := _override()) is not None:
        return [given]
    return [each for each in sorted(_SHARED.glob("hilctl-*")) if not each.is_symlink()]


def _files() -> Iterator[Path]:
    return (path for folder in _folders() for path in sorted(folder.glob("*.json")))


def _own_folder() -> Path:
    """Return this user's folder; create a missing one with a name that no other user can take."""
    if (given := _override()) is not None:
        given.mkdir(parents=True, exist_ok=True)
        return given
    for each in _folders():
        with suppress(OSError):  # another user's
            return private_folder(each, make=False)
    made = Path(tempfile.mkdtemp(prefix=f"hilctl-{os.geteuid()}-", dir=_SHARED))
    made.chmod(0o755)
    return made
