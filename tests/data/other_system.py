"""Run commands as on another system: without its missing names, and with its rules for files.

Started with the system's name as ``sys.platform`` has it there, and the commands on standard input.
"""

import ctypes
import errno
import json
import os
import shutil
import sys
import tempfile
import traceback
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from types import SimpleNamespace
from typing import Any

for loaded in [
    "asyncio",
    "concurrent.futures.process",
    "concurrent.futures.thread",
    "multiprocessing.shared_memory",
    "subprocess",
    "matplotlib.pyplot",
    "numba",
    "pymodbus.client",
    "rich.console",
    "scipy.optimize",
    "serial.tools.list_ports",
    "typer",
    "websockets.asyncio.server",
]:
    import_module(loaded)  # Python's modules and other packages have parts for each system

MISSING = json.loads(Path(__file__).with_name("missing_names.json").read_text(encoding="utf-8"))
LACKING = {
    "win32": {"fcntl", "grp", "posix", "pty", "pwd", "resource", "syslog", "termios", "tty"},
    "darwin": set(),
}


class Absent:
    """Finds no module of those that the system lacks."""

    def __init__(self, names: set[str]) -> None:
        self._names = names

    def find_spec(self, name: str, path: object = None, target: object = None) -> None:
        if name in self._names:
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)


def remove_names(system: str) -> None:
    for module, lines in MISSING[system].items():
        for name in " ".join(lines).split():
            if hasattr(import_module(module), name):
                delattr(import_module(module), name)
    for name in LACKING[system]:
        sys.modules.pop(name, None)
    sys.meta_path.insert(0, Absent(LACKING[system]))


def is_open(path: Any) -> bool:
    """Return whether this process has a file open or mapped."""
    try:
        wanted = Path(path).stat()
    except OSError:
        return False
    for descriptor in Path("/proc/self/fd").iterdir():
        try:
            found = descriptor.stat()
        except OSError:
            continue
        if (found.st_dev, found.st_ino) == (wanted.st_dev, wanted.st_ino):
            return True
    maps = Path("/proc/self/maps").read_text(encoding="utf-8").splitlines()
    return any(line.split()[4] == str(wanted.st_ino) for line in maps)


def refusing(function: Callable[..., Any], refused: Callable[..., bool]) -> Callable[..., Any]:
    """Return a function that raises what Windows does where it refuses the paths."""

    def call(*paths: Any, **named: Any) -> Any:
        # Only shutil.rmtree names a folder so, which it does nowhere else.
        if "dir_fd" not in named and refused(*paths):
            raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), str(paths[0]))
        return function(*paths, **named)

    return call


def keep_open_files() -> None:
    """Refuse what Windows does not do to an open file, or does not open."""
    os.open = refusing(os.open, lambda path, *_: Path(path).is_dir())  # type: ignore[assignment]
    for name in ("unlink", "remove"):
        setattr(os, name, refusing(getattr(os, name), is_open))
    os.replace = refusing(os.replace, lambda old, new: is_open(old) or is_open(new))
    os.rename = refusing(os.rename, lambda old, new: is_open(old) or os.path.lexists(new))
    library = ctypes.CDLL.__init__

    def named(self: Any, name: str | None, *rest: Any, **more: Any) -> None:
        if name is None:
            raise TypeError("LoadLibrary() argument 1 must be str, not None")
        library(self, name, *rest, **more)

    ctypes.CDLL.__init__ = named  # type: ignore[method-assign]


def main(system: str) -> None:
    if sys.platform == "linux":
        remove_names(system)
    if sys.platform == "linux" and system == "win32":
        keep_open_files()
    from hilctl.cli import main as hilctl

    # Python's own way on those systems, chosen as it is imported.
    shutil.disk_usage = lambda path: SimpleNamespace(free=1 << 40)  # type: ignore[assignment]
    tempfile.TemporaryFile = tempfile.NamedTemporaryFile  # type: ignore[assignment]
    codes = []
    for words in json.load(sys.stdin):
        if words == ["--platform"]:  # numba, now that it is loaded, asks as well where it is
            sys.platform = system
            continue
        sys.argv = ["hilctl", *words]
        print(f"--- {' '.join(words)}", file=sys.stderr, flush=True)
        try:
            hilctl()
        except SystemExit as ended:
            codes.append(ended.code or 0)
        except Exception:  # noqa: BLE001
            traceback.print_exc()
            codes.append("traceback")
    print(json.dumps(codes))


if __name__ == "__main__":
    main(sys.argv[1])
