"""Child processes import nothing from the working folder."""

import os
import re
import subprocess
from pathlib import Path

import pytest

from hilctl.base.subprocesses import python_command, safe_import_path

ROOT = Path(__file__).parents[3]


@pytest.fixture
def planted(tmp_path, monkeypatch):
    """A working folder with a module of a name that every child imports."""
    (tmp_path / "socket.py").write_text("raise SystemExit(7)", encoding="utf-8")
    monkeypatch.chdir(tmp_path)


def code_of(*command):
    return subprocess.run(command, check=False).returncode


@pytest.mark.usefixtures("planted")
def test_children_import_nothing_from_the_working_folder():
    first, *_ = python_command()
    assert code_of(first, "-c", "import socket") == 7
    assert code_of(*python_command("-c", "import socket")) == 0
    with safe_import_path():
        assert code_of(first, "-c", "import socket") == 0


@pytest.mark.parametrize("before", [None, "", "1"])
def test_environment_is_restored(monkeypatch, before):
    monkeypatch.delenv("PYTHONSAFEPATH", raising=False)
    if before is not None:
        monkeypatch.setenv("PYTHONSAFEPATH", before)
    with safe_import_path():
        assert os.environ["PYTHONSAFEPATH"] == "1"
    assert os.environ.get("PYTHONSAFEPATH") == before


def test_every_subprocess_is_started_by_python_command():
    own = ROOT / "hilctl" / "base" / "subprocesses.py"
    files = [each for folder in ("hilctl", "drivers") for each in (ROOT / folder).rglob("*.py")]
    texts = {each: each.read_text(encoding="utf-8") for each in files if each != own}
    assert [each for each, text in texts.items() if "sys.executable" in text] == []
    spawned = [each for each, text in texts.items() if re.search(r"ProcessPool|get_context", text)]
    assert all("safe_import_path()" in texts[each] for each in spawned)
