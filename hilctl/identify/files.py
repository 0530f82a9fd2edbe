"""From recordings and tables to the data of an identification, and from a fit to a model file."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from hilctl.base.device import CommandUnit
from hilctl.base.errors import DataError, InputError
from hilctl.base.files import write_text
from hilctl.base.samples import Flag
from hilctl.base.text_table import Column
from hilctl.identify.cycles import find_cycles, loops_from_recording
from hilctl.identify.data import History, Record
from hilctl.identify.fit import Fit
from hilctl.identify.settings import Kind
from hilctl.identify.tables import read_table
from hilctl.models.files import dump_model
from hilctl.recording.data import Recording
from hilctl.recording.reader import read

PUBLISHED_POINTS: dict[Kind, int] = {"ppi": 300, "rdpi": 400, "integrated": 300, "staged": 300}


@dataclass(frozen=True, slots=True)
class TableOptions:
    """How text tables are read; recordings need none of it.

    Attributes:
        command_column: Column of the command, by name or by number from 1.
        displacement_column: Column of the displacement in um.
        time_column: Column of the time in s, where there is one.
        rate_hz: Sample rate, where there is no time column.
        first_row: First data row used, counted from 1.
        last_row: Last data row used; None for all.
        ignore: Rows at the start that are run but not judged.
        whole: Judge the whole history instead of its steady cycle.
        lag_samples: Samples by which the displacement is taken to lag, or ``auto`` for those that
            leave the least error.
    """

    command_column: Column = "current_a"
    displacement_column: Column = "displacement_um"
    time_column: Column | None = None
    rate_hz: float | None = None
    first_row: int = 1
    last_row: int | None = None
    ignore: int = 0
    whole: bool = False
    lag_samples: int | Literal["auto"] = 0


def load_records(
    paths: Sequence[Path], points: int, table: TableOptions, lag_samples: int
) -> tuple[list[Record], CommandUnit | None]:
    """Read everything that a model is to be found from.

    Args:
        paths: Recordings (``.mcap``) and text tables.
        points: Points a loop.
        table: How text tables are read.
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
            if table.whole:
                records.append(history_from_recording(recording))
            else:
                records += loops_from_recording(recording, points)
        else:
            records.append(_from_table(path, points, table, lag_samples))
    if len(units) > 1:
        raise InputError("recordings of devices driven in A and in V can't be fitted together")
    return records, next(iter(units), None)


def history_from_recording(recording: Recording) -> History:
    """Return a run's waveform as a whole, from rest, without the ramp at its end.

    Raises:
        DataError: Samples are missing or have no displacement, so the hysteresis can't be followed.
    """
    samples = recording.samples
    rows = (samples.flags & Flag.RAMP.value) == 0
    index, displacement_um = samples.index[rows], samples.displacement_um[rows]
    whole = index.size > 0 and index[0] == 0 and index[-1] == index.size - 1
    if not whole or not np.isfinite(displacement_um).all():
        raise DataError(
            f"{recording.path}: samples are missing, so it can't be judged as a whole: "
            "leave out --whole to use its steady cycles"
        )
    command = np.ascontiguousarray(samples.command[rows])
    return History(recording.path.name, command, displacement_um, recording.sample_rate_hz)


def _from_table(path: Path, points: int, table: TableOptions, lag_samples: int) -> Record:
    history = read_table(
        path,
        table.command_column,
        table.displacement_column,
        time_column=table.time_column,
        rate_hz=table.rate_hz,
        rows=(table.first_row - 1, table.last_row),
        ignore=table.ignore,
    ).without_lag(lag_samples)
    return history if table.whole else find_cycles(history, points)


def write_model(fit: Fit, path: Path, *, overwrite: bool) -> None:
    """Write the model that was found.

    Raises:
        InputError: The file exists or can't be written.
    """
    write_text(path, dump_model(fit.model), overwrite=overwrite)
