"""From recordings and tables to the data of an identification."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from hilctl.base.device import CommandUnit
from hilctl.base.errors import DataError, InputError
from hilctl.base.samples import Flag
from hilctl.identify.data.cycles import find_cycles, loops_from_recording
from hilctl.identify.data.records import History, Record
from hilctl.identify.data.tables import read_table
from hilctl.identify.settings import IdentifySettings
from hilctl.recording.data import Recording
from hilctl.recording.reader import read


def load_records(
    paths: Sequence[Path], settings: IdentifySettings, lag_samples: int
) -> tuple[list[Record], CommandUnit | None]:
    """Read everything that a model is to be identified from.

    Args:
        paths: Recordings (``.mcap``) and text tables.
        settings: Points a loop, and how files are read.
        lag_samples: Samples by which tables' displacements are taken to lag.

    Returns:
        The loops and histories, and the recordings' command unit (None where there are only
        tables).

    Raises:
        DataError: A file can't be used.
        InputError: Recordings of devices driven in A and in V are mixed.
    """
    records: list[Record] = []
    units: set[CommandUnit] = set()
    for path in paths:
        if path.suffix.lower() == ".mcap":
            recording = read(path)
            units.add(recording.command_unit)
            if settings.whole:
                records.append(history_from_recording(recording))
            else:
                records += loops_from_recording(recording, settings.points)
        else:
            records.append(_from_table(path, settings, lag_samples))
    if len(units) > 1:
        raise InputError("recordings of devices driven in A and in V can't be fitted together")
    return records, next(iter(units), None)


def history_from_recording(recording: Recording) -> History:
    """Return a run's waveform as a whole, from rest, without the ramp at its end.

    Raises:
        DataError: Samples are missing or have no displacement, or the run ramped to its waveform
            from another output, so the hysteresis can't be followed from rest.
    """
    samples = recording.samples
    conditioned = (samples.flags & Flag.CONDITION.value) != 0
    if conditioned.any():  # what was before its conditioning is forgotten
        samples = samples.rows(slice(int(np.argmax(conditioned)), None))
    rows = (samples.flags & Flag.RAMP.value) == 0
    if samples.index.size and samples.index[0] == 0 and not rows[0]:
        raise DataError(
            f"{recording.path}: begins with a ramp from where the output was, so the actuator was "
            "not at rest: leave out --whole to use its steady cycles"
        )
    index, displacement_um = samples.index[rows], samples.displacement_um[rows]
    begins_at = int(samples.index[0]) if conditioned.any() else 0
    whole = index.size > 0 and index[0] == begins_at == index[-1] + 1 - index.size
    if not whole or not np.isfinite(displacement_um).all():
        raise DataError(
            f"{recording.path}: samples are missing, so it can't be judged as a whole: "
            "leave out --whole to use its steady cycles"
        )
    command = np.ascontiguousarray(samples.command[rows])
    ignore = int(np.count_nonzero(conditioned))  # it makes the state, and is not judged
    return History(recording.path.name, command, displacement_um, recording.sample_rate_hz, ignore)


def _from_table(path: Path, settings: IdentifySettings, lag_samples: int) -> Record:
    table = settings.table
    history = read_table(
        path,
        table.command_column,
        table.displacement_column,
        time_column=table.time_column,
        rate_hz=table.rate_hz,
        rows=(table.first_row - 1, table.last_row),
        ignore=table.ignore,
    ).without_lag(lag_samples)
    return history if settings.whole else find_cycles(history, settings.points)
