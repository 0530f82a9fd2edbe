"""YAML in, with the line of every value, and validation that reports all problems at once.

A document remembers where each value stands, so that a broken rule is reported as
``file:line: key: rule, got value (what to do)``.
"""

import logging
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

import yaml
from pydantic import BaseModel, ValidationError

from hilctl.base.errors import ConfigError, Problem
from hilctl.base.files import TextFiles
from hilctl.base.yaml.lenient import PlainReading, readings
from hilctl.base.yaml.messages import Loc, broken_rules, dotted
from hilctl.base.yaml.plain import MAX_DEPTH, compose, scalar

Model = TypeVar("Model", bound=BaseModel)
_log = logging.getLogger(__name__)
_UNREADABLE = "is not readable YAML"


class Document:
    """A YAML file's content with the place of every value.

    Attributes:
        assignments: What :meth:`set` was called with, in order.

    Args:
        name: File name as it should appear in messages.
        text: The YAML text.
        lines: How messages name lines that nobody wrote as such, from the first on; those that
            are left out or empty are named by file and number.

    Raises:
        ConfigError: The text is not YAML, holds a key twice, or is not a mapping.
    """

    def __init__(self, name: str, text: str, lines: Sequence[str] = ()) -> None:
        self.name = name
        self._lines = lines
        self.assignments: list[str] = []
        self._places: dict[Loc, str] = {}
        self._duplicates: list[Problem] = []
        try:
            node = compose(text)
        except yaml.MarkedYAMLError as error:
            line = error.problem_mark.line + 1 if error.problem_mark else 1
            problem = Problem(self._line(line), "", _UNREADABLE, hint=str(error.problem))
            raise ConfigError([problem]) from None
        if not isinstance(node, yaml.MappingNode):
            rule = "must hold a mapping of keys to values"
            raise ConfigError([Problem(f"{name}:1", "", rule)])
        self.data: dict[str, Any] = self._build(node, ())
        if self._duplicates:
            raise ConfigError(self._duplicates)

    def _line(self, number: int) -> str:
        named = self._lines[number - 1] if number <= len(self._lines) else ""
        return named or f"{self.name}:{number}"

    def _build(self, node: yaml.Node, loc: Loc) -> Any:
        self._places.setdefault(loc, self._line(node.start_mark.line + 1))
        if isinstance(node, yaml.MappingNode):
            mapping: dict[Any, Any] = {}
            for key_node, value_node in node.value:
                key = key_node.value
                line = key_node.start_mark.line + 1
                inner = (*loc, key)
                if key in mapping:
                    first = self._places[inner]
                    self._duplicates.append(
                        Problem(self._line(line), dotted(inner), f"stands already at {first}")
                    )
                self._places[inner] = self._line(line)
                mapping[key] = self._build(value_node, inner)
            return mapping
        if isinstance(node, yaml.SequenceNode):
            return tuple(self._build(item, (*loc, i)) for i, item in enumerate(node.value))
        return scalar(node)

    def set(self, assignment: str) -> None:
        """Apply one ``dotted.key=value`` from the command line; the value is read as YAML.

        Raises:
            ConfigError: It is not of that form, a part of the key is not a mapping, or the value
                holds a key twice.
        """
        where = f"--set {assignment}"
        key, equals, text = assignment.partition("=")
        parts = key.strip().split(".")
        if not equals or not all(parts) or len(parts) > MAX_DEPTH:
            raise ConfigError([Problem(where, "", "must be dotted.key=value")])
        try:
            node = compose(text)
        except yaml.MarkedYAMLError as error:
            problem = Problem(where, key, _UNREADABLE, repr(text), str(error.problem))
            raise ConfigError([problem]) from None
        self.data = _replaced(
            self.data, parts, lambda loc: self._set_value(node, loc, where), where
        )
        self.assignments.append(assignment)
        for end in range(1, len(parts)):
            self._places.setdefault(tuple(parts[:end]), where)
        if self._duplicates:
            raise ConfigError([Problem(where, p.key, "stands twice") for p in self._duplicates])

    def _set_value(self, node: yaml.Node | None, loc: Loc, where: str) -> Any:
        stale = [place for place in self._places if place[: len(loc)] == loc]
        for place in stale:
            del self._places[place]
        known = set(self._places)
        value = None if node is None else self._build(node, loc)
        for place in set(self._places) - known:
            self._places[place] = where
        self._places[loc] = where
        return value

    def holds(self, loc: Loc) -> bool:
        """Return whether something stands at a location."""
        return loc in self._places

    def where(self, loc: Loc) -> str:
        """Return ``file:line`` of a value, or of the nearest thing around it."""
        for end in range(len(loc), -1, -1):
            if loc[:end] in self._places:
                return self._places[loc[:end]]
        return self.name

    def validate(
        self,
        model: type[Model],
        *,
        at: Loc = (),
        without: tuple[str, ...] = (),
        context: Mapping[str, Any] | None = None,
    ) -> Model:
        """Build a pydantic model from the document, or from a part of it.

        What can be read in one way only is read so, and stands so in :attr:`data` from then on: see
        :mod:`hilctl.base.yaml.lenient`.

        Args:
            model: What to build.
            at: Where the part stands; all of the document where empty.
            without: Keys that are left out: they belong to somebody else.
            context: What the model's validators find in ``info.context``.

        Raises:
            ConfigError: One or more rules are broken; all are listed.
        """
        while True:
            data = self._at(at)
            if without:
                data = {key: value for key, value in data.items() if key not in without}
            try:
                return model.model_validate(data, context=context)
            except ValidationError as error:
                plain = readings(error, model)
                if not plain:
                    raise ConfigError(broken_rules(error, model, self.where, at)) from None
            for each in plain:
                self._read_as(each, at)

    def _read_as(self, reading: PlainReading, at: Loc) -> None:
        loc = (*at, *reading.loc)
        if reading.said:
            _log.warning("%s: %s: %s", self.where(loc), dotted(loc), reading.said)
        if not reading.is_key:
            parts = [str(part) for part in loc]
            self.data = _replaced(self.data, parts, lambda _: reading.value, self.where(loc))
            return
        old, new = loc[-1], reading.value
        mapping = self._at(loc[:-1])
        if new in mapping:
            first = self.where((*loc[:-1], new))
            raise ConfigError([Problem(self.where(loc), dotted(loc), f"stands already at {first}")])
        renamed = {(new if key == old else key): value for key, value in mapping.items()}
        moved = {
            ((*loc[:-1], new, *place[len(loc) :]) if place[: len(loc)] == loc else place): where
            for place, where in self._places.items()
        }
        self._places = moved
        if len(loc) == 1:
            self.data = renamed
        else:
            parts = [str(part) for part in loc[:-1]]
            self.data = _replaced(self.data, parts, lambda _: renamed, self.where(loc[:-1]))

    def _at(self, loc: Loc) -> Any:
        data: Any = self.data
        for part in loc:
            data = data[part]
        return data


def load_document(path: Path, files: TextFiles | None = None) -> Document:
    """Read a YAML file.

    Args:
        path: The file.
        files: Where it is read from; the disk where None.

    Raises:
        InputError: The file can't be read.
        ConfigError: See :class:`Document`.
    """
    return Document(str(path), (files or TextFiles()).read(path))


def _replaced(
    data: Any, parts: list[str], make: Callable[[Loc], Any], where: str, loc: Loc = ()
) -> Any:
    """Return a copy of nested mappings and tuples with one place made anew."""
    head, rest = parts[0], parts[1:]
    if isinstance(data, tuple) and head in map(str, range(len(data))):
        inner: Loc = (*loc, int(head))
        old = data[int(head)]
    elif isinstance(data, dict):
        inner = (*loc, head)
        old = data.get(head, {})
    else:
        raise ConfigError([Problem(where, dotted((*loc, head)), "there is no such key to set")])
    new = _replaced(old, rest, make, where, inner) if rest else make(inner)
    if isinstance(data, tuple):
        return (*data[: int(head)], new, *data[int(head) + 1 :])
    return {**data, head: new}
