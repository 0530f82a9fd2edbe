"""All exceptions that hilctl raises on purpose.

HilctlError
|-- InputError            invalid input; nothing has moved (exit code 2)
|   |-- ConfigError       an experiment or model file breaks rules
|   |-- ModelError        model parameters break a condition of the model or its inverse
|   `-- DataError         a recording or data file is unreadable or lacks data
`-- RunError              a fault during a run (exit code 3)
    `-- DeviceError       the device rejected a request, failed to answer or disconnected
        `-- UnconfirmedError  the command was sent, but the device cannot confirm it
"""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any


class HilctlError(Exception):
    """Base of all errors raised on purpose; the text is shown to the user."""

    exit_code = 3

    def __reduce__(self) -> tuple[Any, ...]:
        # Exceptions are unpickled by calling the class with the text; some take other arguments.
        return type(self).__new__, (type(self), *self.args), vars(self)


class InputError(HilctlError):
    """Invalid input, such as a missing file or a value out of range."""

    exit_code = 2


@dataclass(frozen=True, slots=True)
class ConfigProblem:
    """One broken rule in a user's file.

    Attributes:
        where: ``file:line`` of the value, or the option it was given with.
        key: Dotted key, for example ``limits.peak_current_a``; empty for the file as a whole.
        value: The invalid value as written; may be empty.
        hint: Suggested fix; may be empty.
    """

    where: str
    key: str
    rule: str
    value: str = ""
    hint: str = ""

    def __str__(self) -> str:
        text = (
            f"{self.where}: {self.key}: {self.rule}" if self.key else f"{self.where}: {self.rule}"
        )
        if self.value:
            text += f", got {self.value}"
        if self.hint:
            text += f" ({self.hint})"
        return text


def broken(key: str, rule: str, value: str = "", hint: str = "") -> ConfigProblem:
    """Return a broken rule whose place in the file is not known yet."""
    return ConfigProblem("", key, rule, value, hint)


class ConfigError(InputError):
    """An experiment or model file breaks one or more rules; all of them are listed."""

    def __init__(self, problems: Iterable[ConfigProblem]) -> None:
        self.problems = tuple(problems)
        super().__init__("\n".join(str(problem) for problem in self.problems))


class ModelError(InputError):
    """Model parameters violate a condition of the model or its inverse, named with its index."""


class DataError(InputError):
    """A recording or data file is unreadable or lacks the requested data."""


class RunError(HilctlError):
    """A run ended early; the output was ramped to the safe value if possible."""


class DeviceError(RunError):
    """A device rejected a value, answered wrongly, or disconnected; names device and operation."""


class UnconfirmedError(DeviceError):
    """The command was sent, but the device cannot confirm it.

    Examples: an output set by unanswered lines that cannot be read back; a write whose correct
    reply equals the request, on a serial line that may echo.
    """
