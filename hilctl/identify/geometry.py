"""The published weighting of loops by their peak hysteresis."""

from typing import Literal

import numpy as np

from hilctl.base.arrays import F64
from hilctl.base.errors import DataError
from hilctl.base.metrics import peak_hysteresis_percent
from hilctl.identify.data.records import Records, SteadyLoop


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
        DataError: A record is not a loop.
    """
    loops = [record for record in data if isinstance(record, SteadyLoop)]
    if len(loops) < len(data):
        raise DataError(
            "weights by hysteresis need steady loops, and there is a whole time history among the "
            "data: weight the data equally"
        )
    slowest = min(loops, key=lambda loop: (loop.frequency_hz, -float(np.ptp(loop.command))))
    widths = np.array([_width_percent(loop) for loop in loops])
    return np.asarray(widths / _width_percent(slowest), dtype=np.float64)


def _width_percent(loop: SteadyLoop) -> float:
    width = peak_hysteresis_percent(loop.command, loop.displacement_um)
    assert width is not None  # both signals of a loop move, so it has two branches
    return width
