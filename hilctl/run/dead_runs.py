"""Runs whose processes have died: what they left in memory belongs into their recordings."""

import logging

_log = logging.getLogger(__name__)


def finish_dead_runs() -> None:
    """Recover what dead runs left in memory, and log what was done for each."""
    from hilctl.run.run_folder import runs

    if all(run.alive for run in runs()):
        return
    # Only where there is a dead one: what recovers it takes a second to import.
    from hilctl.run.orphans import recover_orphans

    for orphan in recover_orphans():
        if not orphan.started:
            _log.warning("%s had died before its start: %s", orphan.name, orphan.text)
            continue
        kept = (
            f"its samples are kept in {orphan.kept}; the next command tries again, and "
            f"hilctl recover --dismiss {orphan.name} gives them up"
        )
        done = f"recovered into {orphan.recording}"
        _log.warning("%s was not recorded to its end: %s", orphan.name, orphan.text)
        _log.warning("%s", kept if orphan.kept else done)
