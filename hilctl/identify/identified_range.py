"""The motions that a model is identified on, for whoever runs it."""

import numpy as np
from scipy.fft import rfft, rfftfreq

from hilctl.base.types import F64
from hilctl.experiment.model_validity import ALL, spectrum
from hilctl.identify.data.decimate import turning_points
from hilctl.identify.data.records import History, Record, SteadyLoop
from hilctl.identify.fit_data import FitData
from hilctl.models.base import IdentifiedRange

SMALL, FEWEST_SWINGS = 0.1, 10
NOT_ZERO_UM = 1e-6
LEAST = 0.01  # part of a history's power below its lowest frequency


def identified_range(data: FitData) -> IdentifiedRange:
    """Return what motions, frequencies and speeds the records have."""
    moves = [float(np.ptp(data.target_um[place])) for place in data.places]
    speeds = [
        move * float(speed.max()) / float(np.ptp(record.command))
        for move, speed, record in zip(moves, data.speeds, data.records, strict=True)
    ]
    lowest, highest = zip(*map(frequencies_hz, data.records), strict=True)
    return IdentifiedRange(
        peak_to_peak_um=(min(map(smallest_um, data.records)), max(moves)),
        frequency_hz=(min(lowest), max(highest)),
        speed_um_per_s=max(speeds),
    )


def smallest_um(record: Record) -> float:
    """Return the peak-to-peak displacement of a loop, or of a history's smaller swings.

    A history goes from turn to turn of its command. A tenth of its way it goes in smaller swings:
    noise, or what is left of a decaying cycle, is not much of it.
    """
    if isinstance(record, History):
        at = turning_points(record.command)
        swings_um = np.sort(np.abs(np.diff(record.displacement_um[at])))
        if swings_um.size >= FEWEST_SWINGS:
            way_um = np.cumsum(swings_um)
            found = float(swings_um[np.searchsorted(way_um, SMALL * way_um[-1])])
            return max(found, NOT_ZERO_UM)
    return float(np.ptp(record.displacement_um))


def frequencies_hz(record: Record) -> tuple[float, float]:
    """Return the lowest and the highest frequency of a record's command."""
    command = record.command
    if isinstance(record, SteadyLoop):
        return record.frequency_hz, record.frequency_hz * _below(rfft(command - command.mean()))
    rate_hz = record.sample_rate_hz
    power = np.cumsum(np.abs(rfft(command - command.mean())) ** 2)
    first = int(np.searchsorted(power, LEAST * power[-1]))
    lowest = float(rfftfreq(command.size, 1.0 / rate_hz)[max(first, 1)])
    return lowest, max(lowest, spectrum(command, rate_hz).highest_hz)


def _below(harmonics: F64) -> int:
    power = np.cumsum(np.abs(harmonics) ** 2)
    return max(int(np.searchsorted(power, ALL * power[-1])), 1)
