"""The plain part of YAML: mappings with text keys, lists, numbers, true, false, null and text.

Aliases and tags can make loops, and values that are neither numbers nor text; a configuration needs
neither, so they are refused. A date is text, as in YAML 1.2.
"""

import math
from typing import Any

import yaml
import yaml.composer
import yaml.constructor

MAX_DEPTH = 32
"""Levels of nesting that are read; an experiment has about five."""


class _PlainLoader(yaml.SafeLoader):
    """Refuses what is not plain as it reads."""

    _depth = 0

    def compose_node(self, parent: yaml.Node | None, index: Any) -> yaml.Node | None:
        event: Any = self.peek_event()  # type: ignore[no-untyped-call] # not in the stubs
        is_key = isinstance(parent, yaml.MappingNode) and index is None
        if problem := _not_plain(event, is_key=is_key, depth=self._depth):
            raise yaml.composer.ComposerError(None, None, problem, event.start_mark)
        self._depth += 1
        node = super().compose_node(parent, index)
        self._depth -= 1
        return node


_PlainLoader.yaml_implicit_resolvers = {
    first: [(tag, pattern) for tag, pattern in resolvers if not tag.endswith(":timestamp")]
    for first, resolvers in yaml.SafeLoader.yaml_implicit_resolvers.items()
}


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
        yaml.YAMLError: It is not YAML, or more than the plain part of it.
    """
    try:
        return yaml.compose(text, Loader=_PlainLoader)
    except (ValueError, OverflowError) as error:  # an escape that names no character
        raise yaml.YAMLError(str(error)) from None


def scalar(node: yaml.Node) -> Any:
    """Return a leaf's value: None, a bool, an int, a float, or text where it is none of them.

    A whole number of more than 64 bits is a float: Python won't write out very long ones.
    """
    try:
        value = yaml.constructor.SafeConstructor().construct_object(node)
        too_long = isinstance(value, int) and value.bit_length() > 64
        return float(value) if too_long else value
    except OverflowError:
        return math.inf
    except (ValueError, yaml.YAMLError):
        return node.value
