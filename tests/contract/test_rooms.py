"""Other rooms import the modules in a room's ``PUBLIC`` only, and every entry has such a user."""

import ast
from importlib import import_module
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PACKAGES = {"hilctl": ROOT / "hilctl", "hilctl_drivers": ROOT / "drivers" / "hilctl_drivers"}
LIBRARIES = {"api", "base", "kernels", "lab", "models"}
"""Rooms without private modules."""
ROOMS = {
    ".".join(each.parent.relative_to(PACKAGES["hilctl"]).parts)
    for pattern in ("*/__init__.py", "lab/*/__init__.py")
    for each in PACKAGES["hilctl"].glob(pattern)
} - LIBRARIES


def imports(path):
    """Return the names that a file imports, with those in functions, as ``module.name``."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.ImportFrom):
            found |= {f"{node.module}.{each.name}" for each in node.names}
        elif isinstance(node, ast.Import):
            found |= {f"{each.name}." for each in node.names}
    return found


IMPORTS = {
    path: imports(path) for folder in PACKAGES.values() for path in sorted(folder.rglob("*.py"))
}


def used_by_others(room):
    """Return the modules of a room that files outside of it import."""
    folder = PACKAGES["hilctl"].joinpath(*room.split("."))
    modules = {
        ".".join(each.relative_to(folder).with_suffix("").parts) for each in folder.rglob("*.py")
    }
    names = {
        name for path, found in IMPORTS.items() if not path.is_relative_to(folder) for name in found
    }
    return {
        each
        for each in modules
        if any(f"{name}.".startswith(f"hilctl.{room}.{each}.") for name in names)
    }


@pytest.mark.parametrize("room", sorted(ROOMS))
def test_other_rooms_import_public_modules_only(room):
    public = set(getattr(import_module(f"hilctl.{room}"), "PUBLIC", ()))
    assert used_by_others(room) == public
