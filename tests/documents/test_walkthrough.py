"""README and tutorial do what they say, command by command, in a copy of the repository."""

import os
import shutil
import sys
from pathlib import Path

import pytest

from tests.documents.walkthrough import ROOT, Step, pattern, steps_of, walk

NEEDED = (
    "Makefile", "README.md", "configs", "docs", "pyproject.toml", "requirements",
)  # fmt: skip
"""What the commands read; code is imported from where it is, whose kernels are compiled already."""


@pytest.fixture
def copy(tmp_path):
    """A folder like the repository's, with the environment of these tests as ``.venv``."""
    copied = tmp_path / "hilctl"
    copied.mkdir()
    for name in NEEDED:
        if (ROOT / name).is_dir():
            shutil.copytree(ROOT / name, copied / name, ignore=shutil.ignore_patterns("_*"))
        else:
            shutil.copy(ROOT / name, copied / name)
    (copied / ".venv").mkdir()
    (copied / ".venv" / "bin").symlink_to(Path(sys.executable).parent)
    for made in (".core", ".ready"):  # newer than what make would renew them for
        (copied / ".venv" / made).touch()
    return copied


def walked(document, copied):
    imported = os.pathsep.join((str(ROOT), str(ROOT / "drivers")))
    environment = {**os.environ, "PYTHONPATH": imported, "COLUMNS": "80"}
    wrong = walk(document, copied, environment)
    assert not wrong, "\n\n".join(wrong)


def text_of(name):
    return (ROOT / name).read_text(encoding="utf-8")


@pytest.mark.slow
def test_readme(copy):
    walked(text_of("README.md"), copy)


@pytest.mark.slow
@pytest.mark.timeout(900)  # the search for a model alone takes a minute or two
def test_tutorial(copy):
    walked(text_of("docs/tutorial.md"), copy)


def test_printed_output_is_compared_with_the_document(tmp_path):
    right = "```sh\nprintf 'a 1\\nb 2\\nc 3\\n'\n```\nsays\n```text\na ...\n...\nc 3\n```\n"
    assert walk(right, tmp_path, {"PATH": os.environ["PATH"]}) == []
    for broken in ("c 4", "c 3\nd"):
        [wrong] = walk(right.replace("c 3\n`", f"{broken}\n`"), tmp_path, dict(os.environ))
        assert wrong.startswith("step 0:")
    [ended] = walk("```sh\nfalse\n```\n```sh\ntrue\n```\n", tmp_path, dict(os.environ))
    assert "at step 0" in ended


def test_steps_and_patterns():
    document = "```sh\nmake test  # long\nls\n```\n```python\nprint(1)\n```\n```text\n1\n```\n"
    assert steps_of(document) == [Step("ls\n"), Step("python - <<'END'\nprint(1)\nEND\n", "1\n")]
    assert pattern("│ a... │\n").search("x\n│ a 1 % │\n")
    assert not pattern("a.b\n").search("acb\n")
