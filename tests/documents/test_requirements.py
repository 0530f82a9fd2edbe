"""Locked versions: everything that the package asks for, in one file each."""

import re
import tomllib
from pathlib import Path

ROOT = Path(__file__).parents[2]


def names(lines):
    return {re.split(r"[^\w.-]", line)[0].lower() for line in lines}


def locked(name):
    text = (ROOT / "requirements" / f"{name}.txt").read_text(encoding="utf-8")
    return names(re.findall(r"^\S.*", text, re.MULTILINE))


def test_each_file_holds_what_it_adds():
    core, dev, docs = locked("core"), locked("dev"), locked("docs")
    assert not core & dev
    assert not (core | dev) & docs

    package = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    project, groups = package["project"], package["dependency-groups"]
    assert names(project["dependencies"]) <= core
    assert all(names(lines) <= dev for lines in project["optional-dependencies"].values())
    assert names(groups["dev"]) <= dev
    assert names(groups["docs"]) <= docs
