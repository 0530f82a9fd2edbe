"""What the documents name is there: files, commands, options, sections."""

import re
import shlex
from functools import cache

import pytest

from hilctl.cli.commands import COMMANDS, load
from tests.documents.walkthrough import ROOT

DOCS = ROOT / "docs"
BUILT = ("_build", "_generated")
DECISIONS = ROOT / "docs" / "decisions"
"""Records name files of their time, which later ones have moved or deleted."""
DOCUMENTS = sorted(
    path
    for place in (".", "configs", "docs", "drivers", "examples", "recordings", "tests")
    for path in (ROOT / place).glob("**/*.md" if place == "docs" else "*.md")
    if path.relative_to(ROOT).parts[1:2] not in {(each,) for each in BUILT}
)
LINK = re.compile(r"\]\((?!https?:|mailto:)([^)#\s]*)(?:#([^)\s]+))?\)")
FILE = re.compile(r"`((?:configs|docs|drivers|examples|hilctl|recordings|tests)/[\w./@-]+\w)`")
SHELL = re.compile(r"^ *```sh\n(.*?)^ *```$|^((?: {4,}[^\n]*\n)+)", re.MULTILINE | re.DOTALL)
COMMAND = re.compile(r"^ *hilctl (.+)$", re.MULTILINE)
OF_ITSELF = {"--install-completion"}
"""Options of hilctl itself, which typer adds."""
OPTION = re.compile(r"(?<![\w-])--[a-z][a-z-]+")


def named(path):
    return str(path.relative_to(ROOT))


def anchors(text):
    """Return the anchors of a page's headings."""
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-")
             for heading in re.findall(r"^#+ (.+)$", text, re.MULTILINE)}  # fmt: skip


@cache
def options(name):
    """Return the options of a command and of those within it."""
    command = load(name)
    found = {"--help"}
    for each in (command, *getattr(command, "commands", {}).values()):
        for parameter in each.params:
            found |= {*parameter.opts, *parameter.secondary_opts}
    return found


@pytest.mark.parametrize("path", DOCUMENTS, ids=named)
def test_links_have_targets(path):
    for target, anchor in LINK.findall(path.read_text(encoding="utf-8")):
        base = DOCS if target.startswith("/") else path.parent
        found = (base / target.lstrip("/")) if target else path
        if "_generated" in found.parts:
            continue  # made by the build, which says what is missing
        assert found.exists(), target
        if anchor and not anchor.startswith("key-"):
            assert anchor in anchors(found.read_text(encoding="utf-8")), f"{target}#{anchor}"


@pytest.mark.parametrize("path", DOCUMENTS, ids=named)
def test_named_files_exist(path):
    if path.parent == DECISIONS:
        return
    folders = (ROOT, path.parent)
    for name in FILE.findall(path.read_text(encoding="utf-8")):
        if not name.startswith("docs/_build"):
            assert any((folder / name).exists() for folder in folders), name


def commands(path):
    """Return the commands in the blocks of a document, as words."""
    for fenced, indented in SHELL.findall(path.read_text(encoding="utf-8")):
        for line in COMMAND.findall(re.sub(r"\\\n *", "", fenced or indented)):
            yield shlex.split(line, comments=True)


@pytest.mark.parametrize("path", DOCUMENTS, ids=named)
def test_named_commands_and_options_exist(path):
    for words in commands(path):
        if words[0] in OF_ITSELF:
            continue
        assert words[0] in COMMANDS, words
        given = {word.partition("=")[0] for word in words if word.startswith("--")}
        assert given <= options(words[0]), words
        for word in words[1:]:
            if re.match(r"(configs|examples|tests)/", word):
                assert (ROOT / word).exists(), words


@pytest.mark.parametrize("name", COMMANDS)
def test_every_command_is_in_some_document(name):
    text = "\n".join(path.read_text(encoding="utf-8") for path in DOCUMENTS)
    assert re.search(rf"`?hilctl {name}\b", text)
