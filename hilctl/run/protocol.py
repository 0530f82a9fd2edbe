"""The protocol of a run's control socket: its version and its requests.

``docs/reference/protocol.md`` tells of it.

Importing it costs nothing: clients must not wait for a compiler. What a request may hold is checked
by the run, see ``run/requests.py``.
"""

from typing import Any, Literal, TypeAlias

VERSION = 1
"""Of the protocol; it rises where a message changes its meaning, not where one more key comes."""
VERSION_KEY = "protocol"
"""Key of every answer, where the version stands."""

Command: TypeAlias = Literal["status", "set", "mark"]
InverseState: TypeAlias = Literal["in", "out"]

MAX_BYTES = 4096
"""Longest request."""
MAX_MARK = 200
"""Characters of the longest mark."""


def request(command: Command, **values: Any) -> dict[str, Any]:
    """Return a request; values that are None are left out."""
    given = {key: value for key, value in values.items() if value is not None}
    return {"command": command, **given}
