"""Plain data as YAML for people: short lists in one line, and a comment behind a value."""

import json
from collections.abc import Iterator, Mapping
from typing import Any

from hilctl.base.yaml.plain import dump

_INDENT = "  "


def commented(data: Mapping[str, Any], comments: Mapping[str, str]) -> str:
    """Return plain data as YAML with comments; read back it is the same data.

    Args:
        data: Mappings with text keys, lists of plain values, and what
            :func:`hilctl.base.yaml.plain.dump` takes.
        comments: By dotted key, what stands behind the value, or above a mapping: one line each.
    """
    return "".join(f"{line}\n" for line in _lines(data, comments, ""))


def _lines(data: Mapping[str, Any], comments: Mapping[str, str], above: str) -> Iterator[str]:
    for key, value in data.items():
        dotted = f"{above}{key}"
        comment = f"  # {comments[dotted]}" if dotted in comments else ""
        if isinstance(value, Mapping) and value:
            yield f"{_key(key)}{comment}"
            yield from (_INDENT + line for line in _lines(value, comments, f"{dotted}."))
        elif isinstance(value, list | tuple):
            yield f"{_key(key)} {json.dumps(value, ensure_ascii=False)}{comment}"
        else:
            first, *more = dump({key: value}).splitlines()
            if more and comment:  # behind its first line it would be a part of it
                yield comment.strip()
            yield first if more else f"{first}{comment}"
            yield from more


def _key(key: str) -> str:
    return dump({key: None}).removesuffix(" null\n")
