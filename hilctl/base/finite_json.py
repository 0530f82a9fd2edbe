"""JSON for programs, which has no infinity and nothing that is not a number."""

import json
import math
from collections.abc import Mapping
from typing import Any


def finite_json(value: Any, indent: int | None = None) -> str:
    """Return a value as JSON, with ``null`` for numbers that are not finite."""
    try:
        return json.dumps(value, indent=indent, allow_nan=False)
    except ValueError:
        return json.dumps(_finite(value), indent=indent, allow_nan=False)


def _finite(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {key: _finite(each) for key, each in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(each) for each in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
