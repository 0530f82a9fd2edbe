"""Settings and fixtures that all tests share."""

import gc
import hashlib
import logging
import os
import signal
import sys
import tempfile
from functools import cache, lru_cache
from importlib import import_module
from pathlib import Path

import pytest
from hypothesis import settings

from hilctl.base.private_dirs import memory_folder
from hilctl.base.yaml import io
from hilctl.experiment import devices as registry
from hilctl.kernels.jit import ensure_compiled
from hilctl.run.processes import signal_guardian
from hilctl.run.run_folder import runs
from hilctl_drivers import profile

ROOT = Path(__file__).parents[1]
HARDWARE = Path(__file__).parent / "hardware"
SLOW = tuple(Path(__file__).parent / name for name in ("faults", "peers", "simulated_runs"))
"""Folders whose tests are marked ``slow``; ``make test`` leaves them to ``make test-slow``."""

# Containers often forbid to keep bytecode. Each worker, and each command that a test starts, then
# compiles all modules anew, and that takes longer than the tests.
sys.dont_write_bytecode = False
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)

# Seven thousand tests are collected, and none of them is garbage.
gc.disable()

# A shared machine stalls now and then, and a failure in CI must come back when it is run again.
settings.register_profile("local", deadline=None, max_examples=40)
settings.register_profile("ci", settings.get_profile("local"), derandomize=True)
settings.load_profile("ci" if os.environ.get("CI") else "local")
settings.register_profile("thorough", settings(), max_examples=100)


def pytest_addoption(parser):
    parser.addoption(
        "--device",
        metavar="EXPERIMENT.yaml",
        type=Path,
        help="also run tests/hardware, which moves the real device of this experiment a little",
    )


def pytest_configure(config):
    """Compile the kernels once, before xdist starts workers that would each compile them all."""
    if getattr(config.option, "dist", "no") == "no" or hasattr(config, "workerinput"):
        return
    for root in (ROOT, ROOT / "drivers"):
        for path in sorted(root.glob("hilctl*/**/*.py")):
            if "jit import kernel" in path.read_text(encoding="utf-8"):
                name = ".".join(path.relative_to(root).with_suffix("").parts)
                ensure_compiled(*vars(import_module(name)).values())


def pytest_ignore_collect(collection_path, config):
    """Import nothing of the folders whose tests would all be left out."""
    slow = collection_path in SLOW and config.getoption("markexpr") == "not slow"
    hardware = collection_path == HARDWARE and config.getoption("--device") is None
    return True if slow or hardware else None


@cache
def slow(path):
    """Return whether all tests of a file are slow."""
    return not set(SLOW).isdisjoint(path.parents)


def pytest_collection_modifyitems(config, items):
    """Mark the slow ones; leave tests on real devices out, unless one is named."""
    for item in items:
        if slow(item.path):
            item.add_marker(pytest.mark.slow)
    if config.getoption("--device") is not None:
        return
    hardware = [item for item in items if str(item.path).startswith(f"{HARDWARE}{os.sep}")]
    if hardware:
        config.hook.pytest_deselected(items=hardware)
        items[:] = [item for item in items if item not in hardware]


def pytest_collection_finish():
    """Keep what was imported out of every search for garbage: it takes 0.2 s and finds none."""
    gc.collect()
    gc.freeze()
    gc.enable()


def pytest_report_collectionfinish(config, items):
    """Say what a real device is in for, in one line."""
    experiment = config.getoption("--device")
    if experiment is None:
        return "tests/hardware: left out; --device EXPERIMENT.yaml runs it on a real device"
    return f"tests/hardware: drives the device of {experiment}"


@pytest.fixture(scope="session")
def memory():
    """A folder in memory of this session's own."""
    with tempfile.TemporaryDirectory(prefix="hilctl-tests-", dir=memory_folder()) as folder:
        yield Path(folder)


class LogRecords(logging.Handler):
    """What was logged, like pytest's own, whose plugin takes as long as a short test."""

    def __init__(self):
        super().__init__()
        self.records = []
        self.emit = self.records.append
        self.clear = self.records.clear

    @property
    def messages(self):
        return [record.getMessage() for record in self.records]

    @property
    def text(self):
        return "\n".join(self.messages)


@pytest.fixture
def caplog():
    """What is logged during a test."""
    handler = LogRecords()
    logging.getLogger().addHandler(handler)
    yield handler
    logging.getLogger().removeHandler(handler)


@pytest.fixture(scope="session", autouse=True)
def read_once():
    """Read each YAML text, each profile and what is installed once: all that is only read.

    A shipped profile has hundreds of lines, and hundreds of devices are made of each.
    """
    with pytest.MonkeyPatch.context() as patch:
        for module, name in (
            (io, "compose"), (profile, "parse_profile"), (registry, "entry_points"),
        ):  # fmt: skip
            patch.setattr(module, name, lru_cache(maxsize=256)(getattr(module, name)))
        yield


# Autouse fixtures come before the others of their scope: what a wider fixture starts, it starts in
# the folder of its own scope, and neither a user's command nor another test's can end it.
@pytest.fixture(scope="session", autouse=True)
def session_runs(memory):
    """Keep the runs of session fixtures, and what they left, apart from this user's."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("HILCTL_RUNS", str(memory / "session"))
        patch.setenv("XDG_STATE_HOME", str(memory / "session-state"))
        yield


@pytest.fixture(scope="module", autouse=True)
def module_runs(session_runs, memory, request):
    """Keep the runs of a module's fixtures apart from all others; return their folder."""
    folder = runs_folder(memory, request.node.nodeid)
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("HILCTL_RUNS", str(folder))
        patch.setenv("XDG_STATE_HOME", f"{folder}-state")
        yield folder


@pytest.fixture(autouse=True)
def own_runs(module_runs, memory, monkeypatch, request):
    """Keep each test's runs, and what they left, apart from other tests' and this user's.

    A guardian that still drives a device when the test is over is ended.
    """
    folder = runs_folder(memory, request.node.nodeid)
    monkeypatch.setenv("HILCTL_RUNS", str(folder))
    monkeypatch.setenv("XDG_STATE_HOME", f"{folder}-state")
    yield
    for run in runs() if folder.exists() else []:
        signal_guardian(run, signal.SIGKILL)


def runs_folder(memory, nodeid):
    """Return a short path for each test or module: a socket's path may have 107 characters."""
    return memory / hashlib.sha256(nodeid.encode()).hexdigest()[:16]
