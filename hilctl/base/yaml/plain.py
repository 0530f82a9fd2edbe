r"""The plain part of YAML 1.2: mappings with text keys, lists, and the scalars of its core schema.

A scalar without quotes is, as the core schema says (YAML 1.2.2, section 10.3.2):

    null     ``null``, ``Null``, ``NULL``, ``~``, or nothing at all
    boolean  ``true``, ``True``, ``TRUE``, ``false``, ``False``, ``FALSE``
    integer  ``[-+]?[0-9]+`` (``010`` is ten), ``0o[0-7]+``, ``0x[0-9a-fA-F]+``
    float    ``[-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)([eE][-+]?[0-9]+)?``, ``[-+]?.inf``, ``.nan``
             (also ``.Inf``, ``.INF``, ``.NaN``, ``.NAN``)
    text     everything else: ``yes``, ``on``, ``1:30``, ``1_000``, ``2026-11-21``

Aliases and tags can make loops, and values that are neither numbers nor text; a configuration needs
neither, so they are refused.
"""

import math
import re
from typing import Any

import yaml
from yaml.composer import ComposerError

MAX_DEPTH = 32
"""Levels of nesting that are read; an experiment has about five."""

MAX_CHARACTERS = 2_000_000
"""Longest text that is read; a model of ten thousand operators has a fifth of it."""
MAX_VALUES = 50_000
"""Most values, lists and mappings in a text: their parser takes up to 0.1 ms for each."""

_TAG = "tag:yaml.org,2002:"
_INT = r"[-+]?[0-9]+|0o[0-7]+|0x[0-9a-fA-F]+"
_FLOAT = (
    r"[-+]?(?:\.[0-9]+|[0-9]+(?:\.[0-9]*)?)(?:[eE][-+]?[0-9]+)?"
    r"|[-+]?\.(?:inf|Inf|INF)|\.(?:nan|NaN|NAN)"
)
_CORE = {
    "null": re.compile(r"(?:null|Null|NULL|~|)\Z"),
    "bool": re.compile(r"(?:true|True|TRUE|false|False|FALSE)\Z"),
    "int": re.compile(rf"(?:{_INT})\Z"),
    "float": re.compile(rf"(?:{_FLOAT})\Z"),
}


class _PlainLoader(yaml.SafeLoader):
    """Refuses what is not plain as it reads."""

    yaml_implicit_resolvers = {}  # noqa: RUF012  PyYAML's own way; filled below
    _depth = 0
    _values = 0

    def compose_node(self, parent: yaml.Node | None, index: Any) -> yaml.Node | None:
        event: Any = self.peek_event()  # type: ignore[no-untyped-call] # not in the stubs
        is_key = isinstance(parent, yaml.MappingNode) and index is None
        self._values += not is_key
        if self._values > MAX_VALUES:
            problem = f"more than the {MAX_VALUES} values that are read"
            raise ComposerError(None, None, problem, event.start_mark)
        if problem := _not_plain(event, is_key=is_key, depth=self._depth):
            raise ComposerError(None, None, problem, event.start_mark)
        self._depth += 1
        node = super().compose_node(parent, index)
        self._depth -= 1
        return node


class _PlainDumper(yaml.SafeDumper):
    """Writes no aliases, and quotes every text that YAML 1.1 or 1.2 would read as something else.

    PyYAML's resolvers, which are those of 1.1, stay, so that other programs read the same.
    """

    def ignore_aliases(self, data: Any) -> bool:
        return True


for _name, _pattern in _CORE.items():
    _PlainLoader.add_implicit_resolver(_TAG + _name, _pattern, None)
    _PlainDumper.add_implicit_resolver(_TAG + _name, _pattern, None)


def _not_plain(event: yaml.Event, *, is_key: bool, depth: int) -> str:
    if isinstance(event, yaml.AliasEvent):
        return "aliases (*name) are not supported: write the value out"
    if getattr(event, "tag", None) is not None:
        return "tags (!name) are not supported: write the plain value"
    if is_key and not isinstance(event, yaml.ScalarEvent):
        return "a key must be text"
    if depth > MAX_DEPTH:
        return f"nested more than {MAX_DEPTH} deep"
    if isinstance(event, yaml.ScalarEvent) and event.value != _encodable(event.value):
        return "holds half a character (an escape from \\ud800 to \\udfff)"
    return ""


def _encodable(text: str) -> str:
    return text.encode(errors="ignore").decode()


def compose(text: str) -> yaml.Node | None:
    """Return the text's tree, or None where it holds nothing.

    Raises:
        yaml.MarkedYAMLError: It is not YAML, more than the plain part of it, or too much; says
            where.
    """
    if len(text) > MAX_CHARACTERS:
        problem = f"{len(text)} characters, more than the {MAX_CHARACTERS} that are read"
        raise yaml.MarkedYAMLError(problem=problem)
    try:
        loader = _PlainLoader(text)
    except yaml.reader.ReaderError as error:
        line = text.count("\n", 0, error.position)
        mark = yaml.Mark("", error.position, line, 0, None, 0)
        problem = f"the character U+{ord(text[error.position]):04X} is not allowed"
        raise yaml.MarkedYAMLError(problem=problem, problem_mark=mark) from None
    try:
        return loader.get_single_node()
    except (ValueError, OverflowError):
        problem = "an escape names no character"
        raise yaml.MarkedYAMLError(problem=problem, problem_mark=loader.get_mark()) from None


def scalar(node: yaml.Node) -> Any:
    """Return a leaf's value: None, a bool, an int, a float, or text where it is none of them.

    A whole number of more than 64 bits is a float: Python won't write out very long ones.
    """
    text: str = node.value
    match node.tag.removeprefix(_TAG):
        case "null":
            return None
        case "bool":
            return text.lower() == "true"
        case "int":
            return _whole(text)
        case "float":
            return float(text.lower().replace(".inf", "inf").replace(".nan", "nan"))
    return text


def _whole(text: str) -> int | float:
    base = {"0o": 8, "0x": 16}.get(text[:2], 10)
    try:
        number = int(text, base)
        return number if number.bit_length() <= 64 else float(number)
    except (ValueError, OverflowError):  # thousands of digits
        return -math.inf if text.startswith("-") else math.inf


def is_number(text: str) -> bool:
    """Return whether a text without quotes would be a number."""
    return any(_CORE[name].match(text) is not None for name in ("int", "float"))


def dump(data: Any) -> str:
    """Return plain data as YAML; read back it is the same, bit for bit, lists as tuples.

    Args:
        data: Mappings with text keys, lists and tuples, text, None, booleans, floats, and whole
            numbers of up to 64 bits.

    Raises:
        yaml.YAMLError: It holds anything else.
    """
    return yaml.dump(data, Dumper=_PlainDumper, sort_keys=False, width=100)
