"""Read-only access to /proc, /sys and /dev: the machine, and the usage of this process."""

import os
import shutil
import time
from collections.abc import Callable
from dataclasses import astuple, dataclass
from pathlib import Path
from typing import Literal, Self, TypeAlias

try:
    import pwd
    import resource
except ImportError:  # Windows, on which offline commands import this module
    pwd = resource = None  # type: ignore[assignment]

CAP_IPC_LOCK = 14
"""Number of the capability to lock memory."""
_STATM = Path("/proc/self/statm")

Level: TypeAlias = Literal["ok", "warn", "bad"]


def login_of(user: int) -> str | None:
    """Return the name of a user by its number; None if it has none."""
    try:
        return pwd.getpwuid(user).pw_name
    except KeyError:
        return None


@dataclass(frozen=True, slots=True)
class Finding:
    """Result of one check.

    Attributes:
        level: ``ok``; ``warn``: worth knowing; ``bad``: prevents real time or a run.
    """

    name: str
    level: Level
    text: str
    remedy: str = ""


@dataclass(frozen=True, slots=True)
class Machine:
    """Files of this machine, or of a folder that looks like one.

    Attributes:
        root: Folder that holds ``proc``, ``sys``, ``dev`` and ``etc``.
    """

    root: Path = Path("/")
    writable: Callable[[Path], bool] = lambda path: os.access(path, os.R_OK | os.W_OK)
    free_bytes: Callable[[Path], int] = lambda path: shutil.disk_usage(path).free

    def path(self, name: str) -> Path:
        """Return an absolute path below the root."""
        return self.root / name.lstrip("/")

    def read(self, name: str) -> str:
        """Return the text of a file, such as ``/proc/version``; raise OSError if unreadable."""
        return self.path(name).read_text(encoding="utf-8", errors="replace").strip()

    def text(self, name: str) -> str | None:
        """Return the text of a file; None if it cannot be read."""
        try:
            return self.read(name)
        except OSError:
            return None

    def number(self, name: str) -> int | None:
        """Return the integer in a file; None without one."""
        text = self.text(name)
        try:
            return None if text is None else int(text)
        except ValueError:
            return None

    def glob(self, pattern: str) -> list[str]:
        """Return the sorted absolute paths that match a pattern such as ``/dev/ttyUSB*``."""
        found = sorted(self.root.glob(pattern.lstrip("/")))
        return [f"/{path.relative_to(self.root)}" for path in found]

    def status(self, name: str) -> str:
        """Return a value of /proc/self/status; empty if it is missing."""
        for line in (self.text("/proc/self/status") or "").splitlines():
            key, _, value = line.partition(":")
            if key == name:
                return value.strip()
        return ""

    def capable(self, capability: int) -> bool:
        """Return whether this process has a capability, by its number in capabilities(7)."""
        return bool(int(self.status("CapEff") or "0", 16) >> capability & 1)

    def limit(self, name: str) -> int | None:
        """Return a soft limit of /proc/self/limits; None if unlimited, 0 if unknown."""
        for line in (self.text("/proc/self/limits") or "").splitlines():
            if line.startswith(name):
                soft = line[len(name) :].split()[0]
                return None if soft == "unlimited" else int(soft)
        return 0


@dataclass(frozen=True, slots=True)
class ProcessUsage:
    """Resources used by this process, since its start or another reading."""

    resident_bytes: int
    cpu_ns: int
    minor_faults: int
    major_faults: int
    involuntary_switches: int

    @classmethod
    def now(cls) -> Self:
        """Return the usage of this process with all its threads; Linux only."""
        pages = int(_STATM.read_text(encoding="ascii").split()[1])
        taken = resource.getrusage(resource.RUSAGE_SELF)
        return cls(
            resident_bytes=pages * os.sysconf("SC_PAGE_SIZE"),
            cpu_ns=time.process_time_ns(),
            minor_faults=taken.ru_minflt,
            major_faults=taken.ru_majflt,
            involuntary_switches=taken.ru_nivcsw,
        )

    def since(self, before: "ProcessUsage") -> "ProcessUsage":
        """Return the difference from an earlier reading; memory is the current value."""
        pairs = zip(astuple(self)[1:], astuple(before)[1:], strict=True)
        return ProcessUsage(self.resident_bytes, *(now - then for now, then in pairs))
