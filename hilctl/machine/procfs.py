"""What is read of a machine: its /proc, /sys and /dev, or a folder that looks like them."""

import os
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, TypeAlias

Level: TypeAlias = Literal["ok", "warn", "bad"]


@dataclass(frozen=True, slots=True)
class Finding:
    """What one check found.

    Attributes:
        name: What was looked at.
        level: ``ok``; ``warn``, worth knowing; ``bad``, no real time or no run this way.
        text: What is there.
        remedy: What to do about it; empty where there is nothing to do.
    """

    name: str
    level: Level
    text: str
    remedy: str = ""


def _writable(path: Path) -> bool:
    return os.access(path, os.R_OK | os.W_OK)


def _free_bytes(path: Path) -> int:
    return shutil.disk_usage(path).free


@dataclass(frozen=True, slots=True)
class Machine:
    """A machine seen through its files.

    Attributes:
        root: Folder that holds ``proc``, ``sys``, ``dev`` and ``etc``.
        writable: Whether this user may open a file for writing.
        free_bytes: Free space of the file system that holds a folder.
    """

    root: Path = Path("/")
    writable: Callable[[Path], bool] = _writable
    free_bytes: Callable[[Path], int] = _free_bytes

    def path(self, name: str) -> Path:
        """Return the place of an absolute path on this machine."""
        return self.root / name.lstrip("/")

    def read(self, name: str) -> str:
        """Return the text of a file, such as ``/proc/version``.

        Raises:
            OSError: It can't be read.
        """
        return self.path(name).read_text(encoding="utf-8", errors="replace").strip()

    def text(self, name: str) -> str | None:
        """Return the text of a file; None where it is absent, unreadable or forbidden."""
        try:
            return self.read(name)
        except OSError:
            return None

    def number(self, name: str) -> int | None:
        """Return the whole number in a file; None where there is none."""
        text = self.text(name)
        try:
            return None if text is None else int(text)
        except ValueError:
            return None

    def glob(self, pattern: str) -> list[str]:
        """Return the absolute paths that fit a pattern such as ``/dev/ttyUSB*``, in order."""
        found = sorted(self.root.glob(pattern.lstrip("/")))
        return [f"/{path.relative_to(self.root)}" for path in found]

    def status(self, name: str) -> str:
        """Return a line of this process's /proc/self/status; empty where there is none."""
        for line in (self.text("/proc/self/status") or "").splitlines():
            key, _, value = line.partition(":")
            if key == name:
                return value.strip()
        return ""

    def capable(self, capability: int) -> bool:
        """Return whether this process has a capability, by its number in capabilities(7)."""
        return bool(int(self.status("CapEff") or "0", 16) >> capability & 1)

    def limit(self, name: str) -> int | None:
        """Return a soft limit of /proc/self/limits; None where unlimited.

        An unknown limit is 0: then nothing is promised.
        """
        for line in (self.text("/proc/self/limits") or "").splitlines():
            if line.startswith(name):
                soft = line[len(name) :].split()[0]
                return None if soft == "unlimited" else int(soft)
        return 0
