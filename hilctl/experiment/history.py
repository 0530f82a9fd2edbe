"""What the last run of a device left in its actuator, where a recording of it says so.

The newest recording of the same device in the folders that runs are written to is taken, or none:
an older one would leave out what came after it. A device is the same by what it holds alone while
it is open; simulated ones hold nothing, and begin at rest whenever they are made.
"""

import json
from collections.abc import Sequence
from pathlib import Path

from hilctl.base.errors import DataError
from hilctl.experiment.initial_state import InitialState, initial_state_after
from hilctl.experiment.load import LoadedExperiment
from hilctl.recording.facts import HOLDS_FACT
from hilctl.recording.reader import read_run_facts

_LARGEST_BYTES = 256 << 20  # some minutes at 50 kHz: more would keep the start waiting


def left_by_last_run(
    loaded: LoadedExperiment, folder: Path | None = None
) -> tuple[InitialState | None, str]:
    """Return where the last run left the actuator, or None for rest; and which, or why, in words.

    Args:
        loaded: The experiment; it has a compensator.
        folder: Folder that this run is written to, where that is not ``recording.folder``.

    Raises:
        ModelError: The model has no inverse.
    """
    config, model, holds = loaded.config, loaded.model, loaded.device.info.holds
    if not holds or model is None:
        return None, "at rest"
    folders = dict.fromkeys([Path(config.recording.folder), *([folder] if folder else [])])
    path = _newest([*folders], holds)
    if path is None:
        where = " and ".join(str(each) for each in folders)
        return None, f"at rest: no recording of this device in {where}"
    try:
        left, why = None, f"{path}: is larger than {_LARGEST_BYTES >> 20} MB"
        if path.stat().st_size <= _LARGEST_BYTES:
            left = initial_state_after(path, model, config.sample_rate_hz)
    except (DataError, OSError) as error:
        left, why = None, str(error)
    if left is None:
        return None, f"at rest, what the last run left is not known: {why}"
    return left, f"where {path} left the actuator"


def _newest(folders: Sequence[Path], holds: Sequence[str]) -> Path | None:
    """Return the newest recording of a device in some folders."""
    aged = []
    for path in (path for folder in folders for path in folder.glob("*.mcap")):
        try:
            aged.append((path.stat().st_mtime_ns, path))
        except OSError:  # it has gone meanwhile
            continue
    for _, path in sorted(aged, reverse=True):
        try:
            facts = read_run_facts(path)
        except DataError:  # not one of hilctl, or without a beginning
            continue
        if facts.get(HOLDS_FACT) == json.dumps(list(holds)):
            return path
    return None
