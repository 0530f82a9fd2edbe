"""YAML in, with the line of every value, and validation that reports all problems at once.

A document remembers where each value stands, so that a broken rule is reported as
``file:line: key: rule, got value (what to do)``.
"""

import types
import typing
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, TypeAlias, TypeVar

import yaml
from pydantic import BaseModel, ValidationError
from pydantic_core import ErrorDetails

from hilctl.base.errors import ConfigError, Problem
from hilctl.base.files import TextFiles
from hilctl.base.yaml.messages import hint_of, rule_of, value_of
from hilctl.base.yaml.plain import MAX_DEPTH, compose, scalar

Loc: TypeAlias = tuple[str | int, ...]
Model = TypeVar("Model", bound=BaseModel)


class Document:
    """A YAML file's content with the place of every value.

    Args:
        name: File name as it should appear in messages.
        text: The YAML text.

    Raises:
        ConfigError: The text is not YAML, holds a key twice, or is not a mapping.
    """

    def __init__(self, name: str, text: str) -> None:
        self.name = name
        self._places: dict[Loc, str] = {}
        self._duplicates: list[Problem] = []
        try:
            node = compose(text)
        except yaml.YAMLError as error:
            raise ConfigError([_syntax_problem(name, error)]) from None
        if not isinstance(node, yaml.MappingNode):
            rule = "must hold a mapping of keys to values"
            raise ConfigError([Problem(f"{name}:1", "", rule)])
        self.data: dict[str, Any] = self._build(node, ())
        if self._duplicates:
            raise ConfigError(self._duplicates)

    def _build(self, node: yaml.Node, loc: Loc) -> Any:
        self._places.setdefault(loc, f"{self.name}:{node.start_mark.line + 1}")
        if isinstance(node, yaml.MappingNode):
            mapping: dict[Any, Any] = {}
            for key_node, value_node in node.value:
                key = key_node.value
                line = key_node.start_mark.line + 1
                inner = (*loc, key)
                if key in mapping:
                    first = self._places[inner]
                    self._duplicates.append(
                        Problem(f"{self.name}:{line}", dotted(inner), f"stands already at {first}")
                    )
                self._places[inner] = f"{self.name}:{line}"
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
        except yaml.YAMLError as error:
            hint = _syntax_problem("", error).hint
            problem = Problem(where, key, "is not readable YAML", repr(text), hint)
            raise ConfigError([problem]) from None
        self.data = _replaced(
            self.data, parts, lambda loc: self._set_value(node, loc, where), where
        )
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

        Args:
            model: What to build.
            at: Where the part stands; all of the document where empty.
            without: Keys that are left out: they belong to somebody else.
            context: What the model's validators find in ``info.context``.

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
            problems: list[Problem] = []
            for detail in error.errors(include_url=False):
                cause = detail.get("ctx", {}).get("error")
                if isinstance(cause, ConfigError):  # of a file that a validator has read
                    problems += cause.problems
                else:
                    problems.append(self._problem(model, detail, at))
            raise ConfigError(problems) from None

    def _problem(self, model: type[BaseModel], detail: ErrorDetails, at: Loc) -> Problem:
        loc, parent = _plain_loc(model, detail["loc"])
        loc = (*at, *loc)
        if detail["type"] == "union_tag_invalid":
            loc = (*loc, "kind")
        hint = hint_of(detail, list(parent.model_fields) if parent else [])
        return Problem(self.where(loc), dotted(loc), rule_of(detail), value_of(detail), hint)


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


def dotted(loc: Loc) -> str:
    """Return a location as a dotted key, list indices included."""
    return ".".join(str(part) for part in loc)


def _syntax_problem(name: str, error: yaml.YAMLError) -> Problem:
    where, hint = name, " ".join(str(error).split())
    if isinstance(error, yaml.MarkedYAMLError):
        line = error.problem_mark.line + 1 if error.problem_mark else 1
        where, hint = f"{name}:{line}", str(error.problem)
    return Problem(where, "", "is not readable YAML", hint=hint)


def _replaced(data: Any, parts: list[str], make: Any, where: str, loc: Loc = ()) -> Any:
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


def _models_in(annotation: Any) -> Iterator[type[BaseModel]]:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        yield annotation
    elif isinstance(annotation, types.GenericAlias) or typing.get_origin(annotation) is not None:
        for inner in typing.get_args(annotation):
            yield from _models_in(inner)


def _tags(model: type[BaseModel]) -> tuple[Any, ...]:
    field = model.model_fields.get("kind")
    return typing.get_args(field.annotation) if field else ()


def _plain_loc(model: type[BaseModel], loc: Loc) -> tuple[Loc, type[BaseModel] | None]:
    """Drop union tags from a pydantic location; also return the model that the last key is in."""
    plain: list[str | int] = []
    candidates = [model]
    parent: type[BaseModel] | None = model
    for part in loc:
        chosen = [c for c in candidates if part in _tags(c)] if len(candidates) > 1 else []
        if chosen:
            candidates = chosen
            continue
        plain.append(part)
        parent = candidates[0] if candidates else None
        if isinstance(part, str):
            field = parent.model_fields.get(part) if parent else None
            candidates = list(_models_in(field.annotation)) if field else []
    return tuple(plain), parent
