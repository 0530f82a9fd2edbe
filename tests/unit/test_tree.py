"""Every module has its unit tests in the file of its name, and every such file its module."""

import ast
from collections import Counter
from pathlib import Path

UNIT = Path(__file__).parent
ROOT = UNIT.parents[1]
PACKAGES = {Path(): ROOT / "hilctl", Path("drivers"): ROOT / "drivers" / "hilctl_drivers"}

WITHOUT = {
    "api/responses": "one call each; cli/test_responses.py makes all of them",
    "base/types": "names of types; waveforms/test_build.py reads arrays in chunks",
    "base/device": "the contract of devices: tests/contract/test_devices.py holds each to it",
    "base/events": "one record of plain values; seen in run/shared/test_shared_page.py",
    "cli/options": "types of options; cli/test_commands.py loads every command that has them",
    "drivers/emulator/registers": "test_modbus_wire.py, and tests/peers with other clients",
    "drivers/session": "what protocols share; drivers/test_dac_setup.py and the protocols' own",
    "drivers/wire": "the contract of wires: drivers/test_dac.py holds a device on each to it",
    "drivers/contract": "the checks of tests/contract; test_bad_devices.py makes each of them fail",
    "experiment/recording_settings": "keys: experiment/test_file.py; size: run/test_unpaced.py",
    "loop/plan": "two records of plain values; loop/test_loop.py fills and reads all of them",
    "run/result": "records of plain values; unit/run/test_unpaced.py reads them",
    "recording/metadata_keys": "names; analysis/test_catalogue.py reads all of them",
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


def test_names_are_unique():
    """No public class occurs twice, no module name more than three times."""
    files = [file for package in PACKAGES.values() for file in package.rglob("*.py")]
    classes = Counter(
        node.name
        for file in files
        for node in ast.parse(file.read_text(encoding="utf-8")).body
        if isinstance(node, ast.ClassDef) and not node.name.startswith("_")
    )
    stems = Counter(file.stem for file in files if not file.stem.startswith("__"))
    assert [name for name, count in classes.items() if count > 1] == []
    assert [name for name, count in stems.items() if count > 3] == []
