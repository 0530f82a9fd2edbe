"""Collect text that pages include from other files, before each build; called by conf.py.

Writes to ``_generated``: sections of the documents of the repository, tables of the keys of the
schemas, and the help of commands.
"""

import ast
import json
import re
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from hilctl import api
from hilctl.cli.commands import COMMANDS, GROUPS, load
from hilctl.lab.pages.html import DEFINITIONS

ROOT = Path(__file__).parents[1]
DOCUMENTS = {
    "readme": "README.md",
    "configs": "configs/README.md",
    "drivers": "drivers/README.md",
    "recordings": "recordings/README.md",
    "examples": "examples/README.md",
    "contributing": "CONTRIBUTING.md",
}
"""Documents that pages include, by the folder of their sections."""

PAGES = {
    "CONTRIBUTING.md": "/contributing.md",
    "CHANGELOG.md": "/changelog.md",
    "drivers/README.md": "/reference/devices.md",
    "configs/README.md": "/reference/experiment.md",
    "recordings/README.md": "/reference/recording.md",
    "examples/README.md": "/howto/examples.md",
}
"""Page of each document that another one links to."""

_SECTION = re.compile(r"^#{1,2} (.+)$", re.MULTILINE)
_LINK = re.compile(r"\[([^\]]+)\]\((?!https?:|#)([^)#]+)(#[^)]*)?\)")
_ATTRIBUTE = re.compile(r"^ {4}(\w+): (.+?)(?=^ {4}\w|\Z)", re.MULTILINE | re.DOTALL)
_LITERAL = re.compile(r"``(.+?)``")


def gather_all(docs: Path) -> None:
    """Write all texts that pages include.

    Args:
        docs: Folder of the pages.
    """
    generated = docs / "_generated"
    shutil.rmtree(generated, ignore_errors=True)
    for name, document in DOCUMENTS.items():
        for slug, text in sections(ROOT / document, docs):
            _write(generated / name / f"{slug}.md", text)
    schema = json.loads((ROOT / "configs" / "schema.json").read_text())
    _write(generated / "experiment_keys.md", keys_page(schema))
    profiles = ROOT / "drivers" / "hilctl_drivers" / "profiles" / "schema.json"
    _write(generated / "profile_keys.md", keys_page(json.loads(profiles.read_text())))
    _write(generated / "commands.md", commands_page())
    _write(generated / "api_names.md", api_page())
    _write(generated / "api_returned.md", returned_page())
    terms = "\n".join(f"**{term}**\n: {meaning}\n" for term, meaning in DEFINITIONS.items())
    _write(generated / "definitions.md", terms)


def _write(path: Path, text: str) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text, encoding="utf-8")


def sections(document: Path, docs: Path) -> Iterator[tuple[str, str]]:
    """Split a document at the headings of its first two levels.

    Returns:
        Per section its heading in lower case with hyphens, and its text without the
        heading. Links refer to pages; a file without a page is replaced by its name.

    Raises:
        ValueError: A link refers to a missing file.
    """
    parts = _SECTION.split(document.read_text(encoding="utf-8"))
    for heading, text in zip(parts[1::2], parts[2::2], strict=True):

        def page(found: re.Match[str]) -> str:
            target = (document.parent / found[2]).resolve()
            if not target.exists():
                raise ValueError(f"{document}: link to a missing file: {found[2]}")
            if target.is_relative_to(docs):
                return f"[{found[1]}](/{target.relative_to(docs)}{found[3] or ''})"
            name = str(target.relative_to(ROOT))
            return f"[{found[1]}]({PAGES[name]}{found[3] or ''})" if name in PAGES else f"`{name}`"

        slug = re.sub(r"[^a-z0-9]+", "-", heading.lower()).strip("-")
        yield slug, _LINK.sub(page, text)


def keys_page(schema: dict[str, Any]) -> str:
    """Return tables of all keys of a schema: top level, then each nested mapping."""
    blocks = [_table(schema)] if "properties" in schema else [f"{_values(schema)}\n"]
    for name, part in schema["$defs"].items():
        if "properties" in part:
            blocks.append(f"({_anchor(name)})=\n### {name.removeprefix('device_')}\n")
            blocks.append(_intro(part) + _table(part))
    return "\n".join(blocks)


def _anchor(name: str) -> str:
    return f"key-{name.lower().replace('_', '-')}"


def _intro(part: dict[str, Any]) -> str:
    text = part.get("description", "").partition("Attributes:")[0]
    return _plain(text).strip() + "\n\n"


def _plain(text: str) -> str:
    text = re.sub(r":\w+:`~?([^`]*\.)?([^`]+)`", r"`\2`", " ".join(text.split()))
    return _LITERAL.sub(r"`\1`", text).replace("|", r"\|")


def _table(part: dict[str, Any]) -> str:
    said = dict(_ATTRIBUTE.findall(part.get("description", "").partition("Attributes:\n")[2]))
    rows = ["| key | value | default | meaning |", "|---|---|---|---|"]
    for key, value in part["properties"].items():
        meaning = value.get("description") or said.get(key, "")
        meaning = meaning or ("selects this section" if key == "kind" else "")
        default = "*required*" if key in part.get("required", ()) else _default(value)
        rows.append(f"| `{key}` | {_values(value)} | {default} | {_plain(meaning)} |")
    return "\n".join(rows) + "\n"


def _default(value: dict[str, Any]) -> str:
    default = value.get("default")
    return "" if default in (None, "") else f"`{json.dumps(default)}`"


_RULES = {
    "minimum": "≥ {}", "exclusiveMinimum": "> {}", "maximum": "≤ {}", "exclusiveMaximum": "< {}",
    "minItems": "at least {} of them", "maxItems": "at most {} of them",
}  # fmt: skip


def _values(value: dict[str, Any]) -> str:
    """Return a short description of the values of a key."""
    if "$ref" in value:
        name = value["$ref"].rpartition("/")[2]
        return f"[{name.removeprefix('device_')}](#{_anchor(name)})"
    if "const" in value:
        return f"`{value['const']}`"
    if "enum" in value:
        return ", ".join(
            f"`{str(each).encode('unicode_escape').decode()}`" for each in value["enum"]
        )
    for choice in ("anyOf", "oneOf"):
        if choice in value:
            found = [_values(each) for each in value[choice] if each.get("type") != "null"]
            return " or ".join(dict.fromkeys(found))
    rules = [text.format(value[rule]) for rule, text in _RULES.items() if rule in value]
    return ", ".join([_kind(value), *rules])


def _kind(value: dict[str, Any]) -> str:
    kind = value.get("type", "any")
    if kind == "array":
        inner = value.get("prefixItems")
        if inner is None:
            return f"list of {_values(value['items'])}" if value.get("items") else "list"
        return f"[{', '.join(_values(each) for each in inner)}]"
    if kind == "object":
        inner = value.get("additionalProperties")
        return f"mapping of {_values(inner)}" if isinstance(inner, dict) else "mapping"
    return {"string": "text", "boolean": "`true`, `false`"}.get(kind, kind)


def commands_page() -> str:
    """Return one section per group of commands, with the help of each command."""
    return "\n".join(
        "\n".join((f"## {group}\n", *map(_command, names))) for group, names in GROUPS.items()
    )


def _command(name: str) -> str:
    inner = getattr(load(name), "commands", {})
    blocks = [f"### {name}\n", _typer(name, f"hilctl {name}")]
    for each in inner:
        blocks += [f"#### {name} {each}\n", _typer(f"{name}:{each}", f"hilctl {name} {each}")]
    return "\n".join(blocks)


def _typer(place: str, name: str) -> str:
    return (
        f"```{{typer}} gather.{place}\n"
        f":prog: {name}\n:preferred: text\n:markup-mode: markdown\n:width: 68\n```\n"
    )


def api_page() -> str:
    """Return a section with every public name of ``hilctl.api`` and its docstring."""
    blocks = ["```{eval-rst}", ".. currentmodule:: hilctl.api", ""]
    for name in api.__all__:
        kind = "class" if isinstance(getattr(api, name), type) else "function"
        blocks += [f".. auto{kind}:: {name}", *(["   :members:"] * (kind == "class")), ""]
    return "\n".join([*blocks, "```", ""])


def returned_page() -> str:
    """Return the result classes of the functions of ``hilctl.api`` from their annotations.

    The modules import these classes for the type checker only, so they are read from the source.
    """
    found: dict[str, str] = {}
    for module in sorted((ROOT / "hilctl" / "api").glob("*.py")):
        tree = ast.parse(module.read_text(encoding="utf-8"))
        imported = {
            alias.name: f"{line.module}.{alias.name}"
            for line in ast.walk(tree)
            if isinstance(line, ast.ImportFrom)
            for alias in line.names
        }
        for function in tree.body:
            if isinstance(function, ast.FunctionDef) and function.name in api.__all__:
                name = ast.unparse(function.returns or ast.Constant("")).strip("'")
                if name in imported and name not in api.__all__:
                    found[name] = imported[name]
    blocks = [f".. autoclass:: {place}\n   :members:\n" for place in found.values()]
    return "\n".join(["```{eval-rst}", *blocks, "```", ""])


def __getattr__(name: str) -> Any:
    """Return a command for the directive that renders its help."""
    if name not in COMMANDS:
        raise AttributeError(name)
    return load(name)
