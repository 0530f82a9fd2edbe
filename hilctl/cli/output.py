"""What all commands print: JSON for programs, and what they did for runs that had died."""

import json
import sys
from typing import Any


def print_json(value: dict[str, Any]) -> None:
    """Print one JSON object."""
    print(json.dumps(value, indent=2, allow_nan=False))


def finish_orphans() -> None:
    """Recover what runs whose processes have died left in memory, and say so."""
    from hilctl.run.run_folder import runs

    if all(run.alive for run in runs()):
        return
    # Only where there is a dead one: what recovers it takes a second to import.
    from hilctl.run.orphans import recover_orphans

    for orphan in recover_orphans():
        print(f"hilctl: {orphan.name} had died: {orphan.text}", file=sys.stderr)
        kept = f"its samples are kept in {orphan.kept}; the next command tries again"
        done = f"recovered into {orphan.recording}"
        print(f"hilctl: {kept if orphan.kept else done}", file=sys.stderr)
