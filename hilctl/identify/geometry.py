"""Figures of a loop: its area, its peak hysteresis, and the published weighting by it."""

from typing import Literal

import numpy as np

from hilctl.base.arrays import F64
from hilctl.base.errors import DataError
from hilctl.identify.data.records import Records, SteadyLoop

REVERSAL = 1e-3  # change against the branch's direction that is still noise, of the peak-to-peak


def loop_area(command: F64, displacement_um: F64) -> float:
    """Return the area that a closed loop bounds, in command units times um, >= 0."""
    following = np.roll(displacement_um, -1)
    return abs(
        0.5 * float(np.sum((np.roll(command, -1) - command) * (displacement_um + following)))
    )


def peak_hysteresis_percent(loop: SteadyLoop) -> float:
    """Return the largest width of a loop at one command, in percent of its peak-to-peak output.

    Raises:
        DataError: The command has more than one maximum or minimum in a cycle, so that there are
            more than two branches.
    """
    command = np.roll(loop.command, -int(np.argmin(loop.command)))
    displacement_um = np.roll(loop.displacement_um, -int(np.argmin(loop.command)))
    top = int(np.argmax(command))
    up, down = slice(0, top + 1), slice(top, None)
    noise = REVERSAL * float(np.ptp(command))
    if np.any(np.diff(command[up]) < -noise) or np.any(np.diff(command[down]) > noise):
        raise DataError(
            f"{loop.label}: the peak hysteresis needs a command with one maximum and one minimum "
            "a cycle: leave this loop out or weight loops equally"
        )
    levels = np.linspace(command[0], command[top], loop.command.size)
    ascending = np.interp(levels, np.maximum.accumulate(command[up]), displacement_um[up])
    falling = np.append(command[down], command[0])[::-1]
    descending = np.interp(
        levels,
        np.maximum.accumulate(falling),
        np.append(displacement_um[down], displacement_um[0])[::-1],
    )
    width = float(np.max(np.abs(descending - ascending)))
    return 100.0 * width / float(np.ptp(loop.displacement_um))


def weight_roots(data: Records, weight_by: Literal["equal", "hysteresis"]) -> F64:
    """Return the square root of each judged sample's weight: float64[N].

    Raises:
        DataError: See :func:`hysteresis_weights`.
    """
    sizes = [
        record.command.size - (0 if isinstance(record, SteadyLoop) else record.ignore)
        for record in data
    ]
    weights = np.ones(len(sizes)) if weight_by == "equal" else hysteresis_weights(data)
    return np.repeat(np.sqrt(weights), sizes)


def hysteresis_weights(data: Records) -> F64:
    """Return the published weight A of each record's squared errors (5.14).

    It is the peak hysteresis of a loop, in percent, over that at the lowest frequency there is
    (of the largest command, where several have that frequency).

    Returns:
        float64[records].

    Raises:
        DataError: A record is not a loop, or see :func:`peak_hysteresis_percent`.
    """
    loops = [record for record in data if isinstance(record, SteadyLoop)]
    if len(loops) < len(data):
        raise DataError(
            "weights by hysteresis need steady loops, and there is a whole time history among the "
            "data: weight the data equally"
        )
    slowest = min(loops, key=lambda loop: (loop.frequency_hz, -float(np.ptp(loop.command))))
    widths = np.array([peak_hysteresis_percent(loop) for loop in loops])
    return np.asarray(widths / peak_hysteresis_percent(slowest), dtype=np.float64)
