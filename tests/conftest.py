"""Settings and fixtures that all tests share."""

import hashlib
import os
import tempfile
from pathlib import Path

import pytest
from hypothesis import settings

from hilctl.base.private import memory_folder

HARDWARE = Path(__file__).parent / "hardware"
SLOW = tuple(Path(__file__).parent / name for name in ("faults", "peers", "simulated_runs"))
"""Folders whose tests are marked ``slow``; ``make test`` leaves them to ``make test-slow``."""

# A shared machine stalls now and then, and a failure in CI must come back when it is run again.
settings.register_profile("local", deadline=None)
settings.register_profile("ci", deadline=None, derandomize=True)
settings.load_profile("ci" if os.environ.get("CI") else "local")


def pytest_addoption(parser):
    parser.addoption(
        "--device",
        metavar="EXPERIMENT.yaml",
        type=Path,
        help="also run tests/hardware, which moves the real device of this experiment a little",
    )


def pytest_collection_modifyitems(config, items):
    """Mark the slow ones; leave tests on real devices out, unless one is named."""
    for item in items:
        if set(SLOW) & set(item.path.parents):
            item.add_marker(pytest.mark.slow)
    if config.getoption("--device") is not None:
        return
    hardware = [item for item in items if HARDWARE in item.path.parents]
    if hardware:
        config.hook.pytest_deselected(items=hardware)
        items[:] = [item for item in items if item not in hardware]


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


# Autouse fixtures come before the others of their scope: what a wider fixture starts, it starts in
# the folder of its own scope, and neither a user's command nor another test's can end it.
@pytest.fixture(scope="session", autouse=True)
def session_runs(memory):
    """Keep the runs of session fixtures apart from this user's."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("HILCTL_RUNS", str(memory / "session"))
        yield


@pytest.fixture(scope="module", autouse=True)
def module_runs(session_runs, memory, request):
    """Keep the runs of a module's fixtures apart from all others; return their folder."""
    folder = runs_folder(memory, request.node.nodeid)
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("HILCTL_RUNS", str(folder))
        yield folder


@pytest.fixture(autouse=True)
def own_runs(module_runs, memory, monkeypatch, request):
    """Keep each test's runs apart from those of other tests and of this user."""
    monkeypatch.setenv("HILCTL_RUNS", str(runs_folder(memory, request.node.nodeid)))


def runs_folder(memory, nodeid):
    """Return a short path for each test or module: a socket's path may have 107 characters."""
    return memory / hashlib.sha256(nodeid.encode()).hexdigest()[:16]
