"""Every exception that hilctl raises on purpose.

HilctlError
|-- InputError            what the user gave can't be used; nothing has moved (exit code 2)
|   |-- ConfigError       an experiment or model file breaks rules
|   |-- ModelError        model parameters that can't describe or invert an actuator
|   `-- DataError         a recording or a data file can't be read or doesn't hold what is asked
`-- RunError              something went wrong while current was flowing (exit code 3)
    `-- DeviceError       the device refused, answered wrongly or went away
        `-- UnconfirmedError  the command was sent; this device has no way to confirm it
"""

from collections.abc import Iterable
from dataclasses import dataclass


class HilctlError(Exception):
    """Base of all errors raised on purpose; its text is meant for the user as it stands."""


class InputError(HilctlError):
    """What the user gave can't be used.

    Example scenarios: a file is missing, an output path can't be written, a command-line value is
    out of range. Raised before anything moves.
    """


@dataclass(frozen=True, slots=True)
class ConfigProblem:
    """One broken rule in a user's file.

    Attributes:
        where: ``file:line`` of the value, or the option it was given with.
        key: Dotted key, for example ``limits.peak_current_a``; empty for the file as a whole.
        rule: What must hold, in words.
        value: The offending value as the user wrote it; empty where there is none.
        hint: What to do about it; empty where the rule says it all.
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


class ConfigError(InputError):
    """An experiment or model file breaks one or more rules; all of them are listed.

    Example scenarios: unknown key, a text where a number belongs, a limit of the wrong sign, a
    compensator with a reference in amperes, a reference outside the model's range.
    """

    def __init__(self, problems: Iterable[ConfigProblem]) -> None:
        self.problems = tuple(problems)
        super().__init__("\n".join(str(problem) for problem in self.problems))

    def __reduce__(self) -> tuple[type["ConfigError"], tuple[tuple[ConfigProblem, ...]]]:
        return ConfigError, (self.problems,)


class ModelError(InputError):
    """Model parameters break a condition of the model or of its inverse.

    Example scenarios: a weight below zero, thresholds out of order, a cumulative deadband slope
    that is not positive. The text names the condition and the index.
    """


class DataError(InputError):
    """A recording or data file can't be read, or doesn't hold what is asked of it.

    Example scenarios: not an MCAP file, no ``/samples`` topic, a CSV column missing, no steady
    cycle in the data.
    """


class RunError(HilctlError):
    """A run had to end early; the output was ramped to its safe value where that was possible."""


class DeviceError(RunError):
    """A device refused a value, answered wrongly, or went away.

    Example scenarios: a command outside the device's range, a time-out, an unplugged cable. The
    text names the device and what it was doing.
    """


class UnconfirmedError(DeviceError):
    """The command was sent; this device has no way to confirm it.

    Example scenarios: an output that is set by lines that are not answered and that cannot be read
    back; a write whose correct reply equals the request, on a serial line that may be an echo.
    """
