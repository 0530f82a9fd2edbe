"""Every package has a folder of unit tests, and every such folder its package."""

import ast
from collections import Counter
from pathlib import Path

UNIT = Path(__file__).parent
ROOT = UNIT.parents[1]
PACKAGES = {Path(): ROOT / "hilctl", Path("drivers"): ROOT / "drivers" / "hilctl_drivers"}


def packages():
    """Return every package with modules, as its place in this folder."""
    return {
        room / path.parent.relative_to(package)
        for room, package in PACKAGES.items()
        for path in package.rglob("*.py")
        if not path.stem.startswith("__")
    }


def folders():
    """Return the folders that have tests."""
    return {path.parent.relative_to(UNIT) for path in UNIT.rglob("test_*.py")} - {Path()}


def test_packages_and_folders_of_unit_tests_are_the_same():
    """A small package may have one file of tests; tests of several packages are elsewhere."""
    assert packages() == folders()


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
