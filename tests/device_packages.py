"""Packages of ``tests/data`` with devices or kinds of model, installed for a test."""

import configparser
import os
import tomllib
from importlib.metadata import EntryPoint
from pathlib import Path

from hilctl.experiment import devices
from hilctl.models import kinds

DATA = Path(__file__).parent / "data"


def project(name):
    """Return the project table of a package."""
    return tomllib.loads((DATA / name / "pyproject.toml").read_text(encoding="utf-8"))["project"]


def installed(name, site):
    """Install a package into a folder; return the environment of commands that use it.

    The files are written from the package's project file, because building it needs a network.
    """
    known = project(name)
    facts = site / f"{name}-{known['version']}.dist-info"
    facts.mkdir(parents=True)
    (site / name).symlink_to(DATA / name / name)
    words = f"Metadata-Version: 2.1\nName: {known['name']}\nVersion: {known['version']}\n"
    (facts / "METADATA").write_text(words)
    points = configparser.ConfigParser()
    points.read_dict(known["entry-points"])
    with (facts / "entry_points.txt").open("w") as file:
        points.write(file)
    before = os.environ.get("PYTHONPATH", "")
    return {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, (str(site), before)))}


def installed_here(name, monkeypatch):
    """Install a package into this process."""
    monkeypatch.syspath_prepend(DATA / name)
    known = project(name)["entry-points"]

    def found(group):
        return [EntryPoint(key, value, group) for key, value in known.get(group, {}).items()]

    monkeypatch.setattr(devices, "entry_points", found)
    monkeypatch.setattr(
        kinds, "registered", lambda group: {point.name: point for point in found(group)}
    )
