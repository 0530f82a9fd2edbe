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

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # before NumPy is imported, as in the command

from hilctl.base import yaml
from hilctl.base.private_dirs import memory_folder
from hilctl.experiment import devices as registry
from hilctl.kernels.jit import ensure_compiled
from hilctl.run.processes import signal_guardian
from hilctl.run.run_folder import runs
from hilctl_drivers import profile
from tests.rigs import DEVICES

ROOT = Path(__file__).parents[1]
HARDWARE = Path(__file__).parent / "hardware"
SLOW = tuple(Path(__file__).parent / name for name in ("faults", "peers", "simulated_runs"))
"""Folders whose tests are marked ``slow``; ``make test`` leaves them to ``make test-slow``."""

# Many containers disable bytecode files. Each worker and each command of a test would compile all
# modules again, which takes longer than the tests.
sys.dont_write_bytecode = False
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)

gc.disable()  # until all tests are collected: thousands of objects, and no garbage

# No deadlines, because a shared machine stalls; in CI every failure must be reproducible.
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
    """Compile the kernels once, before xdist starts workers that would compile them all."""
    if getattr(config.option, "dist", "no") == "no" or hasattr(config, "workerinput"):
        return
    for root in (ROOT, ROOT / "drivers"):
        for path in sorted(root.glob("hilctl*/**/*.py")):
            if "jit import kernel" in path.read_text(encoding="utf-8"):
                name = ".".join(path.relative_to(root).with_suffix("").parts)
                ensure_compiled(*vars(import_module(name)).values())


def pytest_ignore_collect(collection_path, config):
    """Import no test of a folder whose tests are all deselected."""
    slow = collection_path in SLOW and config.getoption("markexpr") == "not slow"
    hardware = collection_path == HARDWARE and config.getoption("--device") is None
    return True if slow or hardware else None


def pytest_collection_modifyitems(config, items):
    """Mark the slow tests; deselect tests on real devices unless a device is named."""
    within = cache(lambda path: {*path.parents})
    for item in items:
        if not within(item.path).isdisjoint(SLOW):
            item.add_marker(pytest.mark.slow)
    hardware = [item for item in items if HARDWARE in within(item.path)]
    if hardware and config.getoption("--device") is None:
        config.hook.pytest_deselected(items=hardware)
        items[:] = [item for item in items if item not in hardware]


def pytest_collection_finish():
    """Exclude imported modules from garbage collection, which takes 0.2 s and finds none."""
    gc.collect()
    gc.freeze()
    gc.enable()


def pytest_report_collectionfinish(config, items):
    """Print in one line what happens to a real device."""
    experiment = config.getoption("--device")
    if experiment is None:
        return "tests/hardware: left out; --device EXPERIMENT.yaml runs it on a real device"
    return f"tests/hardware: drives the device of {experiment}"


@pytest.fixture(scope="session")
def memory():
    with tempfile.TemporaryDirectory(prefix="hilctl-tests-", dir=memory_folder()) as folder:
        yield Path(folder)


class LogRecords(logging.Handler):
    """Log records, like those of pytest's plugin, which takes as long as a short test."""

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
    handler = LogRecords()
    logging.getLogger().addHandler(handler)
    yield handler
    logging.getLogger().removeHandler(handler)


@pytest.fixture
def other_rigs(monkeypatch):
    """Make the rigs of other physics known to the experiments of a test."""
    for name, place in DEVICES.items():
        monkeypatch.setitem(registry.BUILTIN, name, place)


@pytest.fixture(scope="session", autouse=True)
def read_once():
    """Read each YAML text, each profile and the entry points once; they do not change."""
    readers = ((yaml, "compose"), (profile, "parse_profile"), (registry, "entry_points"))
    with pytest.MonkeyPatch.context() as patch:
        for module, name in readers:
            patch.setattr(module, name, lru_cache(maxsize=256)(getattr(module, name)))
        yield


# Autouse fixtures come before the others of their scope. The runs of a session's or a module's
# fixtures are in folders of their own, where no other command can end them.
@pytest.fixture(scope="session", autouse=True)
def session_runs(memory):
    """Separate the runs of session fixtures, and their state, from this user's."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("HILCTL_RUNS", str(memory / "session"))
        patch.setenv("XDG_STATE_HOME", str(memory / "session-state"))
        yield


@pytest.fixture(scope="module", autouse=True)
def module_runs(session_runs, memory, request):
    """Separate the runs of a module's fixtures from all others; return their folder."""
    folder = runs_folder(memory, request.node.nodeid)
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("HILCTL_RUNS", str(folder))
        patch.setenv("XDG_STATE_HOME", f"{folder}-state")
        yield folder


@pytest.fixture(autouse=True)
def own_runs(module_runs, memory, monkeypatch, request):
    """Separate each test's runs, and their state, from those of other tests and this user.

    A guardian that is still active after the test is killed.
    """
    folder = runs_folder(memory, request.node.nodeid)
    monkeypatch.setenv("HILCTL_RUNS", str(folder))
    monkeypatch.setenv("XDG_STATE_HOME", f"{folder}-state")
    yield
    for run in runs() if folder.exists() else []:
        signal_guardian(run, signal.SIGKILL)


def runs_folder(memory, nodeid):
    """Return a short path for a test or module (a socket's path has at most 107 characters)."""
    return memory / hashlib.sha256(nodeid.encode()).hexdigest()[:16]
