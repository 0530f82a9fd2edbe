"""What is locked: the same versions in every file, and all that the package asks for."""

import re
import tomllib
from pathlib import Path

ROOT = Path(__file__).parents[2]
FILES = {path.name: path for path in sorted(ROOT.glob("requirements*.txt"))}
PIN = re.compile(r"^([A-Za-z0-9._-]+)==(\S+)(?: ; (.+?))? ?\\$", re.MULTILINE)


def pins(name):
    found = PIN.findall(FILES[name].read_text(encoding="utf-8"))
    return {(package.lower(), marker): version for package, version, marker in found}


def test_no_package_is_locked_at_two_versions():
    """Tests, documentation and users run the same code."""
    everything = pins("requirements-docs.txt")
    for name in FILES:
        assert pins(name).items() <= everything.items()


def test_all_that_the_package_asks_for_is_locked():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    asked = {
        "requirements.txt": project["dependencies"],
        "requirements-dev.txt": project["optional-dependencies"]["dev"],
        "requirements-docs.txt": project["optional-dependencies"]["docs"],
    }
    for name, texts in asked.items():
        locked = {package for package, _ in pins(name)}
        wanted = {re.split(r"[<>=~\[]", text)[0].lower() for text in texts} - {"hilctl"}
        assert wanted <= locked


def test_every_pin_has_a_hash():
    for path in FILES.values():
        for entry in re.split(r"\n(?=\S)", path.read_text(encoding="utf-8")):
            assert entry.startswith("#") or "--hash=sha256:" in entry
