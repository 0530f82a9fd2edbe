"""What all commands share: JSON for programs, and what they do for runs that had died."""

from typing import Any

from hilctl.base.formatting import finite_json


def print_json(value: dict[str, Any]) -> None:
    """Print one JSON object, with ``null`` for numbers that are not finite."""
    print(finite_json(value, indent=2))


def finish_orphans() -> None:
    """Recover what runs whose processes have died left in memory, and log it to standard error."""
    from hilctl.run.dead_runs import finish_dead_runs

    finish_dead_runs()
