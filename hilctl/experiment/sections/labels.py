"""The ``labels`` section: a user's own keys of a run, also given by ``--label``."""

import json
import re
from collections.abc import Sequence
from typing import Annotated, TypeAlias

from hilctl.base.errors import ConfigError, ConfigProblem
from hilctl.base.strict import AfterValidator, Field, StringConstraints

MOST_LABELS = 32
LONGEST_TEXT = 500
_KEY = "[A-Za-z][A-Za-z0-9_]{0,39}"
_NUMBER = re.compile(r"-?(?:0|[1-9]\d*)(?:\.\d+)?(?:[eE][+-]?\d+)?")  # as in JSON


def _key(key: str) -> str:
    if not re.fullmatch(_KEY, key):
        rule = "a key must be at most 40 letters, digits and '_', and begin with a letter"
        raise ValueError(f"{rule}: {key!r}")
    return key


Labels: TypeAlias = Annotated[
    dict[
        Annotated[str, AfterValidator(_key)],
        Annotated[str, StringConstraints(max_length=LONGEST_TEXT)] | int | float,
    ],
    Field(max_length=MOST_LABELS, json_schema_extra={"propertyNames": {"pattern": f"^{_KEY}$"}}),
]


def label_settings(texts: Sequence[str]) -> list[str]:
    """Return ``--label key=value`` as settings over an experiment file.

    A value in the form of a JSON number is a number (so not one with leading zeros, such as a
    serial number); any other value is text.

    Raises:
        ConfigError: Texts of another form; all are listed.
    """
    problems, settings = [], []
    for text in texts:
        key, equals, value = text.partition("=")
        if not equals or not re.fullmatch(_KEY, key):
            rule = "must be key=value; the key is a letter and up to 39 letters, digits and '_'"
            problems.append(ConfigProblem(f"--label {text}", "", rule))
        settings.append(f"labels.{key}={value if _NUMBER.fullmatch(value) else json.dumps(value)}")
    if problems:
        raise ConfigError(problems)
    return settings
