"""Find, start and stop third-party programs.

A missing program skips its tests, and is an error if CI is set.
"""

import ctypes.util
import importlib.util
import os
import select
import shutil
import subprocess
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import pytest

HERE = Path(__file__).parent
LIBMODBUS_SOURCE = HERE.parent / "benchmark" / "exchange.c"
GIVE_UP_S = 240.0

DEBIAN = "apt-get install {}"
NPM = "npm ci --prefix tests/peers"
PYTHON = "pip install --group dev"


def missing(what: str, remedy: str) -> None:
    """Skip the test, or fail if CI is set."""
    text = f"{what} is not installed: {remedy}"
    if os.environ.get("CI"):
        pytest.fail(text)
    pytest.skip(text)


def program(name: str, package: str = "") -> str:
    found = shutil.which(name)
    if found is None:
        missing(name, DEBIAN.format(package or name))
    return str(found)


class Programs:
    """Paths of third-party programs; each method skips or fails if one is missing."""

    program = staticmethod(program)

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    def module(self, name: str) -> None:
        """Check that a Python package is installed, without importing it."""
        if importlib.util.find_spec(name) is None:
            missing(name, PYTHON)

    def node_package(self, name: str) -> str:
        """Return the path of node if an npm package is installed."""
        node = program("node", "nodejs")
        if not (HERE / "node_modules" / name).is_dir():
            missing(f"npm package {name}", NPM)
        return node

    def libmodbus(self) -> str:
        found = ctypes.util.find_library("modbus")
        if found is None:
            missing("libmodbus", DEBIAN.format("libmodbus-dev"))
        return str(found)

    def libmodbus_server(self) -> str:
        self.libmodbus()
        if not Path("/usr/include/modbus/modbus.h").exists():
            missing("libmodbus's header", DEBIAN.format("libmodbus-dev"))
        built = self._folder / "libmodbus_server"
        if not built.exists():
            command = [program("gcc"), "-o", str(built), str(LIBMODBUS_SOURCE), "-lmodbus"]
            subprocess.run(command, check=True)
        return str(built)


@pytest.fixture(scope="session")
def programs(tmp_path_factory) -> Programs:
    return Programs(tmp_path_factory.mktemp("programs"))


def read_line(process: subprocess.Popen) -> str:
    """Return the first line of a program's output."""
    if not select.select([process.stdout], [], [], GIVE_UP_S)[0]:
        raise AssertionError(f"{process.args} said nothing within {GIVE_UP_S:g} s")
    line = process.stdout.readline().strip()
    assert line, f"{process.args} ended at once"
    return line


@contextmanager
def running(command: list[str], fds: tuple[int, ...] = ()) -> Iterator[subprocess.Popen]:
    """Run a program until the end of the block."""
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, pass_fds=fds)
    try:
        yield process
    finally:
        process.kill()
        process.wait()
        process.stdout.close()


@contextmanager
def serial_cable(folder: Path) -> Iterator[tuple[str, str]]:
    """Connect two ptys like a null modem; yield the device files of both ends."""
    ends = [str(folder / f"end{k}") for k in (0, 1)]
    command = [program("socat"), *(f"pty,raw,echo=0,link={end}" for end in ends)]
    with running(command) as process, ExitStack() as held:
        deadline = time.monotonic() + GIVE_UP_S
        while not all(Path(end).exists() for end in ends):
            assert process.poll() is None, "socat ended at once"
            assert time.monotonic() < deadline, "socat made no ptys"
            time.sleep(0.005)
        for end in ends:  # a pty without an open end hangs up, and socat ends
            held.callback(os.close, os.open(end, os.O_RDWR | os.O_NOCTTY))
        yield ends[0], ends[1]
