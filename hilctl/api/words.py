"""Messages of errors in the words of this interface: arguments and settings instead of options.

A message is shared with the command line, and names its options.
"""

import re
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from functools import wraps
from inspect import signature
from typing import ParamSpec, TypeVar

from hilctl.base.errors import HilctlError

_P = ParamSpec("_P")
_T = TypeVar("_T")
_OPTION = re.compile(r"hilctl [a-z]+ --[a-z-]+|--(set )?([a-z][\w.-]*)([ =]-?[\d.]*\d)?")
"""A complete command, or an option with its number or setting."""
_KEEPS_OPTIONS = ContextVar("keeps_options", default=False)


@contextmanager
def options_kept() -> Iterator[None]:
    """Keep options in messages, for the command line."""
    token = _KEEPS_OPTIONS.set(True)
    try:
        yield
    finally:
        _KEEPS_OPTIONS.reset(token)


def in_own_words(function: Callable[_P, _T]) -> Callable[_P, _T]:
    """Return a function whose errors name its arguments."""

    @wraps(function)
    def called(*args: _P.args, **kwargs: _P.kwargs) -> _T:
        try:
            return function(*args, **kwargs)
        except HilctlError as error:
            if not _KEEPS_OPTIONS.get():
                names = signature(function).parameters
                error.args = (reworded(str(error), names), *error.args[1:])
            raise

    called.__module__ = "hilctl.api"  # where pickle finds it
    return called


def reworded(message: str, arguments: Collection[str]) -> str:
    """Return a message with arguments and settings in place of options; commands stay."""
    from hilctl.lab.identify.settings import IdentifySettings, TableSettings

    def word(found: re.Match[str]) -> str:
        is_setting, option, value = found.groups()
        if option is None:
            return found[0]
        name, value = option.replace("-", "_"), (value or "").replace(" ", "=")
        for each in arguments:
            if not is_setting and each in {name, f"{name}_s", f"{name}_hz"}:
                return each + value
        if name in TableSettings.model_fields:
            name = f"table.{name}"
        elif not is_setting and name not in IdentifySettings.model_fields:
            return found[0]
        return f"the setting {name}{value}"

    return _OPTION.sub(word, message)
