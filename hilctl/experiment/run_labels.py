"""Labels of a run: what the lab calls it by, free of any meaning to hilctl."""

import json
import re
from collections.abc import Sequence
from typing import Annotated, Any, TypeAlias

from hilctl.base.errors import ConfigError, ConfigProblem
from hilctl.base.strict import AfterValidator, BeforeValidator, Field, WithJsonSchema
from hilctl.recording.metadata_keys import LabelValue

MOST_LABELS = 32
LONGEST_TEXT = 500
_KEY = "[A-Za-z][A-Za-z0-9_]{0,39}"
_NUMBER = re.compile(r"-?(?:0|[1-9]\d*)(?:\.\d+)?(?:[eE][+-]?\d+)?")  # as in JSON


def _value(value: Any) -> Any:
    if isinstance(value, bool) or not isinstance(value, str | int | float):
        rule = "must be text or a number"
        raise ValueError(f"{rule}: {value!r}")  # noqa: TRY004  pydantic wants this one
    if isinstance(value, str) and len(value) > LONGEST_TEXT:
        raise ValueError(f"must have at most {LONGEST_TEXT} characters: it has {len(value)}")
    return value


def _key(key: str) -> str:
    if not re.fullmatch(_KEY, key):
        rule = "a key must be at most 40 letters, digits and '_', and begin with a letter"
        raise ValueError(f"{rule}: {key!r}")
    return key


def _not_too_many(labels: dict[str, Any]) -> dict[str, Any]:
    if len(labels) > MOST_LABELS:
        raise ValueError(f"must be at most {MOST_LABELS}: there are {len(labels)}")
    return labels


Labels: TypeAlias = Annotated[
    dict[
        Annotated[str, AfterValidator(_key)],
        Annotated[
            LabelValue,
            BeforeValidator(_value),
            WithJsonSchema(
                {"anyOf": [{"type": "string", "maxLength": LONGEST_TEXT}, {"type": "number"}]}
            ),
        ],
    ],
    AfterValidator(_not_too_many),
    Field(
        json_schema_extra={"maxProperties": MOST_LABELS, "propertyNames": {"pattern": f"^{_KEY}$"}}
    ),
]


def label_settings(texts: Sequence[str]) -> list[str]:
    """Return ``--label key=value`` as settings over an experiment file.

    What looks like a number is one, unless it begins with a needless 0, as serial numbers do; all
    else is text as it stands.

    Raises:
        ConfigError: One is not of that form; all such are listed.
    """
    problems, settings = [], []
    for text in texts:
        key, equals, value = text.partition("=")
        if not equals or not re.fullmatch(_KEY, key):
            rule = "must be key=value, the key at most 40 letters, digits and '_' behind a letter"
            problems.append(ConfigProblem(f"--label {text}", "", rule))
        settings.append(f"labels.{key}={value if _NUMBER.fullmatch(value) else json.dumps(value)}")
    if problems:
        raise ConfigError(problems)
    return settings
