r"""YAML 1.2, the plain part: mappings with text keys, lists, and the scalars of its core schema.

A scalar without quotes is, as the core schema says (YAML 1.2.2, section 10.3.2):

    null     ``null``, ``Null``, ``NULL``, ``~``, or nothing at all
    boolean  ``true``, ``True``, ``TRUE``, ``false``, ``False``, ``FALSE``
    integer  ``[-+]?[0-9]+`` (``010`` is ten), ``0o[0-7]+``, ``0x[0-9a-fA-F]+``
    float    ``[-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)([eE][-+]?[0-9]+)?``, ``[-+]?.inf``, ``.nan``
             (also ``.Inf``, ``.INF``, ``.NaN``, ``.NAN``)
    text     everything else: ``yes``, ``on``, ``1:30``, ``1_000``, ``2026-11-21``

Aliases and tags are rejected, because they allow loops and values of other types.
"""

import json
import math
import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

import yaml
from pydantic import BaseModel, ValidationError, ValidationInfo
from pydantic_core import PydanticKnownError
from yaml.composer import ComposerError

from hilctl.base.errors import ConfigError, ConfigProblem, InputError
from hilctl.base.files import TextFiles
from hilctl.base.yaml.errors import NUMBERS, Loc, broken_rules, dotted, odd_characters

MAX_DEPTH = 32
"""Largest nesting depth; an experiment has about five levels."""
MAX_CHARACTERS = 2_000_000
"""Longest text; a model of ten thousand operators has a fifth of it."""
MAX_VALUES = 50_000
"""Largest number of values, lists and mappings; the parser takes up to 0.1 ms for each."""

Model = TypeVar("Model", bound=BaseModel)
Named = TypeVar("Named")
_UNREADABLE = "is not readable YAML"
_TAG = "tag:yaml.org,2002:"


class _PlainLoader(yaml.SafeLoader):
    """Loader that rejects everything but plain YAML."""

    yaml_implicit_resolvers = {}  # noqa: RUF012  PyYAML's own way; filled below
    _depth = 0
    _values = 0

    def compose_node(self, parent: yaml.Node | None, index: Any) -> yaml.Node | None:
        event: Any = self.peek_event()  # type: ignore[no-untyped-call] # not in the stubs
        is_key = isinstance(parent, yaml.MappingNode) and index is None
        self._values += not is_key
        if problem := self._not_plain(event, is_key=is_key):
            raise ComposerError(None, None, problem, event.start_mark)
        self._depth += 1
        node = super().compose_node(parent, index)
        self._depth -= 1
        return node

    def _not_plain(self, event: yaml.Event, *, is_key: bool) -> str:
        if self._values > MAX_VALUES:
            return f"more than the {MAX_VALUES} values that are read"
        if isinstance(event, yaml.AliasEvent):
            return "aliases (*name) are not supported: write the value out"
        if getattr(event, "tag", None) is not None:
            return "tags (!name) are not supported: write the plain value"
        if is_key and not isinstance(event, yaml.ScalarEvent):
            return "a key must be text"
        if self._depth > MAX_DEPTH:
            return f"nested more than {MAX_DEPTH} deep"
        if isinstance(event, yaml.ScalarEvent) and re.search("[\ud800-\udfff]", event.value):
            return "holds half a character (an escape from \\ud800 to \\udfff)"
        return ""


class _PlainDumper(yaml.SafeDumper):
    """Dumper without aliases that quotes texts with another meaning in YAML 1.1 or 1.2.

    It keeps PyYAML's resolvers of YAML 1.1, so that other programs read the same.
    """

    def ignore_aliases(self, data: Any) -> bool:
        return True


for _name, _pattern in {
    "null": r"null|Null|NULL|~|",
    "bool": r"true|True|TRUE|false|False|FALSE",
    **NUMBERS,
}.items():
    for _class in (_PlainLoader, _PlainDumper):
        _class.add_implicit_resolver(_TAG + _name, re.compile(rf"(?:{_pattern})\Z"), None)


def compose(text: str) -> yaml.Node | None:
    """Return the node tree of a text, None if it is empty; raise MarkedYAMLError if not plain."""
    if len(text) > MAX_CHARACTERS:
        problem = f"{len(text)} characters, more than the {MAX_CHARACTERS} that are read"
        raise yaml.MarkedYAMLError(problem=problem)
    try:
        loader = _PlainLoader(text)
    except yaml.reader.ReaderError as error:
        problem = f"the character U+{ord(text[error.position]):04X} is not allowed"
        mark = yaml.Mark("", 0, text.count("\n", 0, error.position), 0, None, 0)
        raise yaml.MarkedYAMLError(problem=problem, problem_mark=mark) from None
    try:
        return loader.get_single_node()
    except (ValueError, OverflowError):
        problem = "an escape names no character"
        raise yaml.MarkedYAMLError(problem=problem, problem_mark=loader.get_mark()) from None


def _scalar(node: yaml.Node) -> Any:
    """Return the value of a scalar: None, a bool, an int, a float, or else text.

    An integer of more than 64 bits is a float, because Python does not print very long ones.
    """
    text: str = node.value
    match node.tag.removeprefix(_TAG):
        case "null":
            return None
        case "bool":
            return text.lower() == "true"
        case "int":
            try:
                number = int(text, {"0o": 8, "0x": 16}.get(text[:2], 10))
                return number if number.bit_length() <= 64 else float(number)
            except (ValueError, OverflowError):  # thousands of digits
                return -math.inf if text.startswith("-") else math.inf
        case "float":
            return float(text.lower().replace(".inf", "inf").replace(".nan", "nan"))
    return text


def dump(data: Any) -> str:
    """Return plain data as YAML; reading it gives the same data, lists as tuples.

    Raises:
        yaml.YAMLError: The data contain other types, or whole numbers of more than 64 bits.
    """
    return yaml.dump(data, Dumper=_PlainDumper, sort_keys=False, width=100)


def commented(data: Mapping[str, Any], comments: Mapping[str, str], above: str = "") -> str:
    """Return plain data as readable YAML with lists on one line, and comments by dotted key.

    A comment is after a value, or above a mapping. ``above`` is the dotted key of the data with a
    trailing dot; empty at the top.
    """
    lines: list[str] = []
    for key, value in data.items():
        name = dump({key: None}).removesuffix(" null\n")
        comment = f"  # {comments[above + key]}" if above + key in comments else ""
        if isinstance(value, Mapping) and value:
            inner = commented(value, comments, f"{above}{key}.").splitlines()
            lines += [f"{name}{comment}", *(f"  {line}" for line in inner)]
        elif isinstance(value, list | tuple):
            lines.append(f"{name} {json.dumps(value, ensure_ascii=False)}{comment}")
        else:
            first, *more = dump({key: value}).splitlines()
            if more and comment:  # after the first line it would be part of the text
                lines.append(comment.strip())
            lines += [first, *more] if more else [f"{first}{comment}"]
    return "".join(f"{line}\n" for line in lines)


class Document:
    """The content of a YAML file with the place of every value.

    Attributes:
        data: Mappings, tuples and scalars; replaced by each change.
        assignments: Arguments of :meth:`set`, in order.

    Args:
        lines: Names of generated lines in messages, from the first on; missing or empty ones are
            named by file and number.

    Raises:
        ConfigError: The text is not YAML, has a duplicate key, or is not a mapping.
    """

    def __init__(self, name: str, text: str, lines: Sequence[str] = ()) -> None:
        self.name = name
        self.assignments: list[str] = []
        self._places: dict[Loc, str] = {}
        self._duplicates: list[ConfigProblem] = []

        def place(mark: yaml.Mark) -> str:
            named = lines[mark.line] if mark.line < len(lines) else ""
            return named or f"{name}:{mark.line + 1}"

        try:
            node = compose(text)
        except yaml.MarkedYAMLError as error:
            where = place(error.problem_mark) if error.problem_mark else f"{name}:1"
            hint = odd_characters(
                text.splitlines(), error.problem_mark.line if error.problem_mark else 0
            ) or str(error.problem)
            raise ConfigError([ConfigProblem(where, "", _UNREADABLE, hint=hint)]) from None
        if not isinstance(node, yaml.MappingNode):
            rule = "must hold a mapping of keys to values"
            raise ConfigError([ConfigProblem(f"{name}:1", "", rule)])
        self.data: dict[str, Any] = self._build(node, (), place)
        if self._duplicates:
            raise ConfigError(self._duplicates)

    def _build(self, node: yaml.Node, loc: Loc, place: Callable[[yaml.Mark], str]) -> Any:
        self._places.setdefault(loc, place(node.start_mark))
        if isinstance(node, yaml.SequenceNode):
            return tuple(self._build(item, (*loc, i), place) for i, item in enumerate(node.value))
        if not isinstance(node, yaml.MappingNode):
            return _scalar(node)
        mapping: dict[str, Any] = {}
        for key, value in node.value:
            inner, where = (*loc, key.value), place(key.start_mark)
            if key.value in mapping:
                rule = f"stands already at {self._places[inner]}"
                self._duplicates.append(ConfigProblem(where, dotted(inner), rule))
            self._places[inner] = where
            mapping[key.value] = self._build(value, inner, place)
        return mapping

    def set(self, assignment: str, option: str = "--set") -> None:
        """Apply one ``dotted.key=value`` of a command line's option; the value is YAML.

        A section that is ``none`` becomes a mapping.

        Raises:
            ConfigError: It has another form, a part of the key is not a mapping, or the value has
                a duplicate key.
        """
        where = f"{option} {assignment}"
        key, equals, text = assignment.partition("=")
        parts = key.strip().split(".")
        if not equals or not all(parts) or len(parts) > MAX_DEPTH:
            raise ConfigError([ConfigProblem(where, "", "must be dotted.key=value")])
        try:
            node = compose(text)
        except yaml.MarkedYAMLError as error:
            problem = ConfigProblem(where, key, _UNREADABLE, repr(text), str(error.problem))
            raise ConfigError([problem]) from None
        loc: Loc = ()
        data: Any = self.data
        for part in parts:
            if isinstance(data, tuple) and part in map(str, range(len(data))):
                loc, data = (*loc, int(part)), data[int(part)]
            elif isinstance(data, dict) or data == "none":
                loc, data = (*loc, part), {} if data == "none" else data.get(part, {})
            else:
                rule = "there is no such key to set"
                raise ConfigError([ConfigProblem(where, dotted((*loc, part)), rule)])
        self._places = {at: old for at, old in self._places.items() if at[: len(loc)] != loc}
        for end in range(1, len(loc) + 1):
            self._places.setdefault(loc[:end], where)
        value = None if node is None else self._build(node, loc, lambda _: where)
        self.data = _replaced(self.data, loc, value)
        self.assignments.append(assignment)
        if self._duplicates:
            raise ConfigError(
                [ConfigProblem(where, p.key, "stands twice") for p in self._duplicates]
            )

    def holds(self, loc: Loc) -> bool:
        """Return whether a location has a value."""
        return loc in self._places

    def where(self, loc: Loc) -> str:
        """Return ``file:line`` of a value, or of its nearest parent."""
        ends = range(len(loc), -1, -1)
        return next((self._places[loc[:end]] for end in ends if self.holds(loc[:end])), self.name)

    def validate(
        self,
        model: type[Model],
        *,
        at: Loc = (),
        without: tuple[str, ...] = (),
        context: Mapping[str, Any] | None = None,
    ) -> Model:
        """Build a pydantic model from the document or its part ``at``, except the keys ``without``.

        ``context`` is for the validators.

        Raises:
            ConfigError: One or more rules are broken; all are listed.
        """
        data: Any = self.data
        for part in at:
            data = data[part]
        if without:
            data = {key: value for key, value in data.items() if key not in without}
        try:
            return model.model_validate(data, context=context)
        except ValidationError as error:
            raise ConfigError(broken_rules(error, model, self.where, at)) from None


def load_document(path: Path, files: TextFiles | None = None) -> Document:
    """Read a YAML file.

    Raises:
        InputError: The file cannot be read.
        ConfigError: See :class:`Document`.
    """
    return Document(str(path), (files or TextFiles()).read(path))


class OptionFileError(ConfigError, ValueError):
    """A file that options name breaks rules; a ``ValueError``: validation collects it."""


def option_file(
    kind: type[Named], load: Callable[[str, TextFiles | None, Path | None], Named]
) -> Callable[[object, ValidationInfo], Named]:
    """Return the validator of an option that names a file, read by ``load``.

    The validation's context may have ``files``, which reads texts, and ``folder``, the base of
    relative paths. So a run uses the checked text, also in another process.
    """

    def named(value: object, info: ValidationInfo) -> Named:
        if isinstance(value, kind):
            return value
        if not isinstance(value, str):
            raise PydanticKnownError("string_type")
        context = info.context or {}
        try:
            return load(value, context.get("files"), context.get("folder"))
        except ConfigError as error:
            raise OptionFileError(error.problems) from None
        except InputError as error:
            raise ValueError(str(error)) from None

    return named


def _replaced(data: Any, loc: Loc, value: Any) -> Any:
    """Return a copy of nested mappings and tuples with one value replaced."""
    if not loc:
        return value
    head, rest = loc[0], loc[1:]
    if isinstance(data, tuple) and isinstance(head, int):
        return (*data[:head], _replaced(data[head], rest, value), *data[head + 1 :])
    before = {} if data == "none" else data
    return {**before, head: _replaced(before.get(head, {}), rest, value)}
