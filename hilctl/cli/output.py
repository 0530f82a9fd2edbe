"""What all commands share: JSON for programs, and what they do for runs that had died."""

import json
from typing import Any


def print_json(value: dict[str, Any]) -> None:
    """Print one JSON object."""
    print(json.dumps(value, indent=2, allow_nan=False))


def finish_orphans() -> None:
    """Recover what runs whose processes have died left in memory, and log it to standard error."""
    from hilctl.run.dead_runs import finish_dead_runs

    finish_dead_runs()
