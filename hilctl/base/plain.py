"""Stands in for pydantic in a process that gets only what another one has checked.

What is imported here has to be imported before :mod:`hilctl.base.strict`, which then makes its
models of this: the same classes, with the same properties and methods, that hold values and check
none. Instances come by pickle from where they were checked.
"""

import copy
from collections.abc import Callable
from typing import Any, Self, TypeVar

F = TypeVar("F")


class Strict:
    """Holds the values of a model's fields; a field that is not given has its default."""

    def __init__(self, **values: Any) -> None:
        self.__dict__.update(values)

    def __setstate__(self, state: dict[str, Any]) -> None:
        # As pydantic gives it: what it keeps beside the values is about their checks.
        self.__dict__.update(state["__dict__"])

    def model_copy(self, *, update: dict[str, Any]) -> Self:
        """Return a copy with other values in some fields."""
        copied = copy.copy(self)
        copied.__dict__.update(update)
        return copied

    def __copy__(self) -> Self:
        return type(self)(**self.__dict__)


class Rule:
    """A rule that nobody is held to."""

    def __init__(self, *_rules: object, **_named: object) -> None: ...


class ValidationError(ValueError):
    """Is never raised."""

    def errors(self) -> list[dict[str, Any]]:
        """Return no problem."""
        return []


def field(default: Any = ..., *, default_factory: Any = None, **_rules: object) -> Any:
    """Return the default of a field."""
    return default if default_factory is None else default_factory()


def validator(*_fields: str, **_rules: object) -> Callable[[F], F]:
    """Return a decorator that leaves a function as it is."""
    return lambda function: function
