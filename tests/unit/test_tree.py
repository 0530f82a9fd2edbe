"""Every module has its unit tests in the file of its name, and every such file its module."""

from pathlib import Path

UNIT = Path(__file__).parent
ROOT = UNIT.parents[1]
PACKAGES = {Path(): ROOT / "hilctl", Path("drivers"): ROOT / "drivers" / "hilctl_drivers"}

WITHOUT = {
    "run/guardian_process": "tests/faults/test_processes.py runs it; run/test_job.py the limits",
    "base/types": "names of types; waveforms/test_build.py reads arrays in chunks",
    "base/device": "the contract of devices: tests/contract/test_devices.py holds each to it",
    "base/events": "one record of plain values; seen in run/test_shared_page.py",
    "cli/options": "types of options; cli/test_commands.py loads every command that has them",
    "drivers/contract": "the checks of tests/contract; test_bad_devices.py makes each of them fail",
    "loop/host": "a contract and a record; loop/test_loop.py runs the loop on a double of it",
    "loop/plan": "two records of plain values; loop/test_loop.py fills and reads all of them",
    "recording/metadata_keys": "names; analysis/test_catalogue.py reads all of them",
    "run/protocol": "constants and small functions; run/test_requests.py and test_client.py use it",
    "recording/recording": "records of plain values; recording/test_reader.py fills them",
}
"""Modules without a file of their own, and where they are tested instead."""


def modules():
    """Return every module but ``__init__`` and ``__main__``, as its test's place in this folder."""
    return {
        (room / path.relative_to(package)).with_suffix("").as_posix()
        for room, package in PACKAGES.items()
        for path in package.rglob("*.py")
        if not path.stem.startswith("__")
    }


def covered():
    """Return what the test files here are named after."""
    files = (path.relative_to(UNIT) for path in UNIT.rglob("test_*.py") if path != Path(__file__))
    return {file.with_name(file.stem.removeprefix("test_")).as_posix() for file in files}


def test_every_module_has_its_tests():
    missing = modules() - covered() - WITHOUT.keys()
    assert not missing, "no test file:\n" + "\n".join(
        f"tests/unit/{Path(name).parent / f'test_{Path(name).name}.py'}" for name in sorted(missing)
    )


def test_every_test_file_has_its_module():
    """Tests of several modules at once belong into another folder, see tests/README.md."""
    lost = covered() - modules()
    assert not lost, "tests of no module:\n" + "\n".join(sorted(lost))


def test_no_exception_has_outlived_its_reason():
    """Each names a module that is there and has no file of its own."""
    stale = WITHOUT.keys() - (modules() - covered())
    assert not stale, "strike from the table:\n" + "\n".join(sorted(stale))
