r"""YAML 1.2, the plain part: mappings with text keys, lists, and the scalars of its core schema.

A scalar without quotes is, as the core schema says (YAML 1.2.2, section 10.3.2):

    null     ``null``, ``Null``, ``NULL``, ``~``, or nothing at all
    boolean  ``true``, ``True``, ``TRUE``, ``false``, ``False``, ``FALSE``
    integer  ``[-+]?[0-9]+`` (``010`` is ten), ``0o[0-7]+``, ``0x[0-9a-fA-F]+``
    float    ``[-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)([eE][-+]?[0-9]+)?``, ``[-+]?.inf``, ``.nan``
             (also ``.Inf``, ``.INF``, ``.NaN``, ``.NAN``)
    text     everything else: ``yes``, ``on``, ``1:30``, ``1_000``, ``2026-11-21``

Aliases and tags are rejected, because they allow loops and values of other types.

Validation errors are put into words: place, key, rule, value, fix.
"""

import json
import math
import re
import types
import typing
import unicodedata
from collections.abc import Callable, Iterable, Mapping, Sequence
from copy import copy
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, NamedTuple, TypeAlias, TypeVar

import yaml
from pydantic import BaseModel, ValidationError, ValidationInfo
from pydantic_core import ErrorDetails, PydanticKnownError
from yaml.composer import ComposerError

from hilctl.base.errors import ConfigError, ConfigProblem, InputError
from hilctl.base.files import TextFiles
from hilctl.base.formatting import did_you_mean
from hilctl.base.strict import HALF_CHARACTER, WORDS, StrictModel, expected, rule_of

Loc: TypeAlias = tuple[str | int, ...]
"""Location of a value: keys and list indices."""

NUMBERS = {
    "int": r"[-+]?[0-9]+|0o[0-7]+|0x[0-9a-fA-F]+",
    "float": r"[-+]?(?:\.[0-9]+|[0-9]+(?:\.[0-9]*)?)(?:[eE][-+]?[0-9]+)?"
    r"|[-+]?\.(?:inf|Inf|INF)|\.(?:nan|NaN|NAN)",
}
"""Regular expressions for plain numbers in YAML 1.2."""

_DASHES = {"\N{MINUS SIGN}", "\N{EN DASH}", "\N{EM DASH}"}
_QUOTED = re.compile(r"'([^']+)'")
_WITHOUT_VALUE = {"missing", "value_error", "extra_forbidden", "union_tag_not_found"}
_NUMBER_TYPES = {"float_type", "int_type", "int_from_float"}
_SPOKEN_BOOLEANS = {"yes", "no", "on", "off", "y", "n"}


class _Broken(NamedTuple):
    """A validation error with its location in the file.

    Attributes:
        loc: Keys and indices without pydantic's names of union members.
        parent: The model with the last key, if any.
        of_choice: Whether the value has the wrong type for one of several union members.
        kinds: Possible kinds of the value, if it needs one.
    """

    detail: ErrorDetails
    loc: Loc
    parent: type[BaseModel] | None
    of_choice: bool
    kinds: tuple[str, ...]


def dotted(loc: Loc) -> str:
    """Return a location as a dotted key, list indices included."""
    return ".".join(map(str, loc))


def loc_of(key: str) -> Loc:
    """Return a dotted key as a location; numbers are list indices."""
    return tuple(int(part) if part.isdecimal() else part for part in key.split("."))


def broken_rules(
    error: ValidationError,
    model: type[BaseModel],
    where: Callable[[Loc], str],
    at: Loc = (),
    data: Any = None,
) -> list[ConfigProblem]:
    """Return all validation errors of a file, one problem per value.

    ``where`` returns the ``file:line`` of a location, or of its nearest parent; ``at`` is the
    location of the model's ``data`` in the file.
    """
    problems: list[ConfigProblem] = []
    broken = [_located(model, detail, data) for detail in error.errors(include_url=False)]
    # Ignore type errors of union members if another member matched the type.
    meant = {
        each.loc[:n] for each in broken if not each.of_choice for n in range(len(each.loc) + 1)
    }
    groups: dict[Loc, list[_Broken]] = {}
    for index, each in enumerate(broken):
        cause = each.detail.get("ctx", {}).get("error")
        if isinstance(cause, ConfigError):  # from another file, with its own place
            problems += cause.problems
        elif not (each.of_choice and each.loc in meant):
            groups.setdefault(each.loc if each.of_choice else (index, *each.loc), []).append(each)
    return problems + [_problem(group, where, at) for group in groups.values()]


def _line(problem: ConfigProblem) -> int:
    """Return the line of a problem; 0 if it has none."""
    found = re.search(r":(\d+)", problem.where)
    return int(found[1]) if found else 0


def _problem(group: list[_Broken], where: Callable[[Loc], str], at: Loc) -> ConfigProblem:
    first = group[0]
    place = loc = (*at, *first.loc)
    rule, *others = (rule_of(each.detail) for each in group)
    rule = ", or ".join([rule, *(other.removeprefix("must be ") for other in others)])
    if first.detail["type"] == "value_error":  # a rule on several keys begins with the key
        place = (*loc, *loc_of(rule.split(" ", 1)[0]))
    known = first.kinds or (first.parent.model_fields if first.parent else ())
    removed = getattr(first.parent, "REMOVED", {}).get(loc[-1] if loc else "")
    hint = removed or next(filter(None, (_hint(each.detail, known) for each in group)), "")
    return ConfigProblem(where(place), dotted(loc), rule, _value(first.detail), hint)


def _value(detail: ErrorDetails) -> str:
    """Return the invalid value on one line; empty if the rule includes it."""
    value, kind = detail["input"], detail["type"]
    if kind in _WITHOUT_VALUE:
        return ""
    if kind == "union_tag_invalid":
        return repr(detail.get("ctx", {})["tag"])
    if value is None or isinstance(value, bool):
        return {None: "nothing", True: "true", False: "false"}[value]
    text = repr(list(value) if isinstance(value, tuple) else value)
    return text if len(text) <= 60 else text[:57] + "..."


def _hint(detail: ErrorDetails, known: Iterable[str]) -> str:
    value, kind = detail["input"], detail["type"]
    if kind == "extra_forbidden":
        return did_you_mean(str(detail["loc"][-1]), known)
    if kind == "union_tag_not_found":
        return f"one of {', '.join(known)}"
    if kind in WORDS:  # the rule lists all of them
        given, words = detail.get("ctx", {}).get("tag", value), _QUOTED.findall(expected(detail))
        if given in words:  # written as Python does, so with an escape
            return f'write it in double quotes: "{given}"'
        return did_you_mean(str(given), words, listed=True) if len(words) > 1 else ""
    if kind in _NUMBER_TYPES and isinstance(value, str):
        return _number_hint(value)
    if kind in _NUMBER_TYPES and isinstance(value, float) and value.is_integer():
        return f"write {value:.0f}"
    if kind == "tuple_type" and isinstance(value, str) and "," in value:
        return f"write [{', '.join(part.strip() for part in value.strip('[]()').split(','))}]"
    if kind == "bool_type" and str(value).lower() in _SPOKEN_BOOLEANS:
        return "write true or false"
    if kind == "string_type" and isinstance(value, bool | int | float):
        return "put it in quotes"
    return ""


def odd_characters(lines: Sequence[str], number: int) -> str:
    """Return which invisible character a line, or the one before it, has; empty for none."""
    for at in range(max(0, number - 1), min(number + 1, len(lines))):
        for mark in lines[at]:
            if mark == "\t" or (mark != " " and unicodedata.category(mark) in {"Zs", "Cf"}):
                named = unicodedata.name(mark, "tab" if mark == "\t" else "without a name")
                called = f"U+{ord(mark):04X} ({named})"
                return f"line {at + 1} has the invisible character {called}: write spaces"
    return ""


def _number_hint(text: str) -> str:
    if text[:1] in _DASHES:
        called = f"{unicodedata.name(text[0])} (U+{ord(text[0]):04X})"
        return f"write the minus of the keyboard instead of {called}"
    if _is_number(text):
        return "remove the quotes"
    if _is_number(point := text.replace(",", ".", 1)):
        return f"{point} or {text.replace(',', '')}? write a decimal point, or none"
    if text[:1] in set("+-.0123456789"):
        return "write a plain number, such as 1000, 0.5 or 1e-3"
    return ""


def _is_number(text: str) -> bool:
    return any(re.fullmatch(pattern, text) for pattern in NUMBERS.values())


def _located(model: type[BaseModel], detail: ErrorDetails, data: Any) -> _Broken:
    """Map pydantic's location to the file, without its names of union members."""
    choices: list[Any] = [model]
    parent: type[BaseModel] | None = None
    plain: list[str | int] = []
    chose = False
    for part in detail["loc"]:
        chose = len(choices) > 1
        if chose:
            choices = [choice for choice in choices if _is_named(choice, part)]
        elif part != "[key]":
            plain.append(part)
            parent = _described(choices[0], data) if choices and _is_model(choices[0]) else None
            choices = _choices(_inner(parent or choices[0], part)) if choices else []
            data = _value_at(data, part)
    kind = detail["type"]
    if kind == "union_tag_invalid":
        plain.append("kind")
    of_choice = chose and (kind == "literal_error" or kind.endswith("_type"))
    kinds: tuple[str, ...] = ()
    if kind == "union_tag_not_found":
        kinds = tuple(name for each in choices for name in _kinds(each))
    return _Broken(detail, tuple(plain), parent, of_choice, kinds)


def _described(model: type[BaseModel], data: Any) -> type[BaseModel]:
    return model.described_by(data) if issubclass(model, StrictModel) else model


def _value_at(data: Any, part: str | int) -> Any:
    """Return the value at a key or index; None without one."""
    if isinstance(data, tuple):
        return data[part] if isinstance(part, int) and part < len(data) else None
    return data.get(part) if isinstance(data, Mapping) else None


def _is_model(annotation: Any) -> bool:
    return isinstance(annotation, type) and issubclass(annotation, BaseModel)


def _is_named(choice: Any, name: str | int) -> bool:
    """Return whether pydantic's name of a union member, its kind or class, matches.

    The class may be inside its validators: ``function-after[_fits(), Flag]``.
    """
    if not _is_model(choice):
        return False
    if re.search(rf"\b{choice.__name__}\]*$", str(name)):
        return True
    return name in _kinds(choice)


def _kinds(choice: Any) -> tuple[Any, ...]:
    """Return the kinds of a union member; none if it has no such key."""
    kind = choice.model_fields.get("kind") if _is_model(choice) else None
    return () if kind is None else typing.get_args(kind.annotation)


def _inner(annotation: Any, part: str | int) -> Any:
    """Return the type of the value at a key or index; None if unknown."""
    if _is_model(annotation):
        field = annotation.model_fields.get(part)
        return field.annotation if field else None
    origin, inner = typing.get_origin(annotation), typing.get_args(annotation)
    if origin in {dict, Mapping}:
        return inner[1]
    if origin is not tuple:
        return None
    if inner[-1] is Ellipsis:
        return inner[0]
    return inner[part] if isinstance(part, int) and part < len(inner) else None


def _choices(annotation: Any) -> list[Any]:
    """Return the union members of a type, or the type itself."""
    origin = typing.get_origin(annotation)
    if origin is Annotated:
        return _choices(typing.get_args(annotation)[0])
    if origin in {typing.Union, types.UnionType}:
        members = [each for each in typing.get_args(annotation) if each is not type(None)]
        return [choice for each in members for choice in _choices(each)]
    return [annotation]


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
            return HALF_CHARACTER
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

    Raise yaml.YAMLError for other types, and for whole numbers of more than 64 bits.
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

    def set(self, assignment: str, option: str = "setting") -> None:
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

    def value(self, loc: Loc) -> Any:
        """Return the value at a location; None without one."""
        if not self.holds(loc):
            return None
        found: Any = self.data
        for part in loc:
            found = found[part]
        return found

    def where(self, loc: Loc) -> str:
        """Return ``file:line`` of a value, or of its nearest parent."""
        ends = range(len(loc), -1, -1)
        return next((self._places[loc[:end]] for end in ends if self.holds(loc[:end])), self.name)

    def copied(self) -> "Document":
        """Return a copy; changes of one do not affect the other."""
        own = copy(self)  # each change replaces data and places
        own.assignments = [*self.assignments]
        return own

    def remove(self, key: str) -> None:
        """Remove a key of the top level, if it is there."""
        self.data = {name: value for name, value in self.data.items() if name != key}
        self._places = {at: where for at, where in self._places.items() if at[:1] != (key,)}

    def part(self, loc: Loc, name: str) -> "Document":
        """Return a copy with the mapping at ``loc`` laid over it, without its parent.

        Mappings are laid over key by key; one of another ``kind`` replaces the one below it. The
        place of a value of the part ends with ``name``.
        """
        over = {
            at[len(loc) :]: f"{where}, {name}"
            for at, where in self._places.items()
            if at[: len(loc)] == loc and len(at) > len(loc)
        }
        own, value = self.copied(), self.value(loc)
        own.remove(str(loc[0]))
        own.lay_over(value, over)
        return own

    def lay_over(self, value: Mapping[str, Any], places: Mapping[Loc, str]) -> None:
        """Lay a mapping over the document, with the places of its values."""
        self.data = _laid_over(self.data, value)
        # Those of a mapping that was replaced would be left over.
        known = {**self._places, **places}.items()
        self._places = {at: where for at, where in known if _is_in(self.data, at)}

    def problem(self, key: str, rule: str, value: str = "", hint: str = "") -> ConfigProblem:
        """Return a broken rule with the place of its dotted key."""
        return ConfigProblem(self.where(loc_of(key)), key, rule, value, hint)

    def refusal(self, problems: Iterable[ConfigProblem]) -> ConfigError:
        """Return the error of broken rules, each with the place of its key."""
        return ConfigError(replace(each, where=self.where(loc_of(each.key))) for each in problems)

    def validate(
        self,
        model: type[Model],
        *,
        at: Loc = (),
        without: tuple[str, ...] = (),
        context: Mapping[str, Any] | None = None,
    ) -> Model:
        """Build a pydantic model from the document or its part ``at``, except the keys ``without``.

        ``context`` is for the validators. Raise ConfigError with all broken rules.
        """
        data = self.value(at)
        if without:
            data = {key: value for key, value in data.items() if key not in without}
        try:
            return model.model_validate(data, context=context)
        except ValidationError as error:
            broken = broken_rules(error, model, self.where, at, data)
            raise ConfigError(sorted(broken, key=_line)) from None


def load_document(path: Path, files: TextFiles | None = None) -> Document:
    """Read a YAML file; raise InputError if it cannot be read, or as :class:`Document` does."""
    return Document(str(path), (files or TextFiles()).read(path))


Settings: TypeAlias = Mapping[str, object] | Sequence[str]
"""Overrides of an experiment: values by dotted key, ``{"waveform.frequency_hz": 50.0}``, or
``key=value`` texts as for ``--set``."""


def texts_of(settings: Settings) -> list[str]:
    """Return settings as ``key=value`` texts.

    Raises:
        TypeError: YAML cannot represent a value.
    """
    if isinstance(settings, Mapping):
        return [setting(key, value) for key, value in settings.items()]
    return [*settings]


def setting(key: str, value: object) -> str:
    """Return the ``key=value`` text that sets a key to a plain value."""
    return f"{key}={json.dumps(value, ensure_ascii=False)}"


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


def _laid_over(under: Any, over: Any) -> Any:
    """Return a value laid over another: mappings key by key, unless their kinds differ."""
    if not (isinstance(under, dict) and isinstance(over, dict)):
        return over
    if under.get("kind", over.get("kind")) != over.get("kind", under.get("kind")):
        return over
    laid = {key: _laid_over(under[key], each) if key in under else each
            for key, each in over.items()}  # fmt: skip
    return {**under, **laid}


def _is_in(data: Any, loc: Loc) -> bool:
    """Return whether data have a value at a location."""
    for part in loc:
        try:
            data = data[part]
        except (KeyError, IndexError, TypeError):
            return False
    return True
