"""Faults of measured data: wrong units, wiring, spikes, steps, clipping, a coil that fails."""

from collections.abc import Iterator, Sequence

import numpy as np

from hilctl.base.types import F64
from hilctl.lab.identify.data.records import History, Record, SteadyLoop, turning_points
from hilctl.lab.identify.settings import FitSettings

AGAINST = -0.3  # correlation of command and displacement with the wrong sign
LEADING = -0.02  # area of a loop, of its rectangle, whose displacement leads the command
MOST_UM = 5000.0
APART = 30.0  # maximum ratio of the gains of records of one actuator
SLOW = 1.5  # of the lowest frequency: loops whose phase is due to hysteresis, not delay
SPIKE = 20.0  # ratio of a spike to what 99 % of the samples differ from their neighbours
KINK = 2.0  # smallest ratio of a spike to the steps of the samples beside it
SPIKE_STROKE = 0.02  # smallest spike or step, of the stroke of all other samples
JUMP = 0.05  # of the command's range: a step of the command is no fault
CLIPPED, FEWEST_CLIPPED = 0.05, 5  # motion of the command, of its range, and samples at one value
LARGE = 0.1  # of the largest swing: smaller ones are ignored
DEAD, FEWEST_DEAD = 0.1, 2  # of the usual displacement per command; swings in a row


def data_reasons(records: Sequence[Record], *, even: bool = False) -> Iterator[str]:
    """Yield faults of the data; an ``even`` displacement may rise with both signs."""
    moves = [float(np.ptp(record.displacement_um)) for record in records]
    largest = int(np.argmax(moves))
    if moves[largest] > MOST_UM:
        yield (
            f"'{records[largest].label}' moves by {moves[largest]:.3g} µm, more than any such "
            "actuator. If the displacement of a table is in nm, set --displacement-scale 0.001"
        )
        return
    gains = np.array([m / np.ptp(r.command) for m, r in zip(moves, records, strict=True)])
    ratio = gains / np.median(gains)
    odd = int(np.argmax(np.abs(np.log(ratio))))
    if not 1.0 / APART < ratio[odd] < APART:
        yield (
            f"'{records[odd].label}' has {ratio[odd]:.3g} times the median gain. Check its units "
            "and the coil, or exclude it with --leave-out"
        )
        return
    slow = _slow(records)
    along = float(np.mean([correlation(record.command, record) for record in slow]))
    if even:
        return
    if along < AGAINST:
        yield (
            "the displacement falls when the command rises: swap the wires of the coil, or invert "
            "the sign of the sensor (--displacement-scale -1 for a table)"
        )
    elif along > 0.0 and float(np.median([_area(record) for record in slow])) < LEADING:
        yield (
            "the displacement leads the command: swap the columns of command and displacement, or "
            "correct their timing"
        )


def record_fault(record: Record, settings: FitSettings) -> str:
    """Return the fault of single samples or of a part of a record, and its cure; or empty."""
    return _still(record) or _jump(record) or _clipped(record) or _far_from_zero(record, settings)


def _jump(record: Record) -> str:
    """Return a spike or a step: it differs from its neighbours by more than all others do."""
    y, u = record.displacement_um, record.command
    off = np.abs(y[1:-1] - 0.5 * (y[2:] + y[:-2]))
    at = int(np.argmax(off)) + 1
    stays_um = float(y[at + 1] - y[at - 1])
    is_step = abs(stays_um) > off[at - 1]
    others_um = float(np.ptp(np.delete(y, at)))
    size_um = abs(stays_um) if is_step else off[at - 1]
    usual_um = float(np.percentile(off, 99.0))
    # At a kink of the displacement, the samples beside it differ as much.
    beside_um = max(np.ptp(y[max(at - 2, 0) : at]), np.ptp(y[at + 1 : at + 3]))
    least_um = max(SPIKE * usual_um, KINK * beside_um)
    if off[at - 1] <= least_um or size_um <= SPIKE_STROKE * others_um:
        return ""
    if not is_step:
        in_table = isinstance(record, History) and record.rows.size
        cure = "remove the value (NaN or an empty cell)" if in_table else "measure again"
        return f"has a spike of {y[at]:.4g} µm at {_place(record, at)}: {cure}"
    if abs(u[at + 1] - u[at - 1]) > JUMP * np.ptp(u):
        return ""
    at += abs(y[at + 1] - y[at]) > abs(y[at] - y[at - 1])  # the first sample after the step
    cure = _without(record, *((0, at) if at < y.size // 2 else (at, y.size)))
    return f"has a step of {stays_um:.3g} µm at {_place(record, at)}{cure}"


def _clipped(record: Record) -> str:
    y, u = record.displacement_um, record.command
    for end in (float(y.max()), float(y.min())):
        edges = np.flatnonzero(np.diff(np.concatenate(([False], y == end, [False]))))
        for start, stop in edges.reshape(-1, 2):
            moves = np.ptp(u[start:stop]) if stop - start >= FEWEST_CLIPPED else 0.0
            if moves > CLIPPED * np.ptp(u):
                share = 100.0 * float(np.mean(y == end))
                return (
                    f"stays at {end:.4g} µm for {share:.2g} % of its samples, first at "
                    f"{_place(record, start)}: the sensor is at the end of its range. "
                    "Move the sensor, or lower the amplitude"
                )
    return ""


def _still(record: Record) -> str:
    """Return a message on a part of a history in which the command moves, the displacement not."""
    if not isinstance(record, History):
        return ""
    turns, y = turning_points(record.command), record.displacement_um
    command = np.abs(np.diff(record.command[turns]))
    large = np.flatnonzero(command > LARGE * command.max(initial=0.0))
    if not large.size:
        return ""
    moves_um = np.maximum.reduceat(y, turns) - np.minimum.reduceat(y, turns)
    gains = moves_um[large] / command[large]
    dead = np.flatnonzero(gains < DEAD * np.median(gains))
    if dead.size < FEWEST_DEAD or np.any(np.diff(dead) > 1):
        return ""
    first, last = int(large[dead[0]]), int(large[dead[-1]]) + 1
    # It may fail within the swing before, and recover within the one after.
    start = int(turns[first - 1]) if first > 0 and dead[0] > 0 else 0
    stop = int(turns[last + 1]) if last + 1 < turns.size else record.command.size
    time_s = record.time_s
    return (
        f"hardly moves from {time_s[turns[first]]:.4g} to {time_s[turns[last]]:.4g} s: check coil, "
        f"amplifier and sensor{_without(record, start, stop)}"
    )


def _place(record: Record, at: int) -> str:
    if not isinstance(record, History):
        return f"point {at + 1}"
    number = f"row {record.rows[at]}" if record.rows.size else f"sample {at + 1}"
    return f"{record.time_s[at]:.4g} s ({number})"


def _without(record: Record, start: int, stop: int) -> str:
    """Return how to identify without the samples from ``start`` to ``stop``."""
    if not (isinstance(record, History) and record.rows.size):
        return ", and measure again"
    if start > record.command.size - stop:
        return f". Use the rows before it with --set table.last_row={record.rows[start] - 1}"
    return f". Use the rows after it with --set table.ignore={stop}"


def _far_from_zero(record: Record, settings: FitSettings) -> str:
    """Return a message if the displacement has an offset that the model lacks."""
    if settings.fit.has_offset:
        return ""
    middle_um = 0.5 * float(record.displacement_um.max() + record.displacement_um.min())
    if abs(middle_um) < float(np.ptp(record.displacement_um)):
        return ""
    hint = "fit it with --set offset=true" if settings.has("offset") else "subtract it"
    return f"has an offset of {middle_um:.4g} µm, more than its stroke: {hint}"


def correlation(signal: F64, record: Record) -> float:
    """Return the correlation of a signal with the displacement; 0 if the signal is constant."""
    if np.ptp(signal) == 0.0:
        return 0.0
    return float(np.corrcoef(signal, record.displacement_um)[0, 1])


def _slow(records: Sequence[Record]) -> list[Record]:
    """Return histories, and the loops at the lowest frequencies."""
    turns = [record.frequency_hz for record in records if isinstance(record, SteadyLoop)]
    most = SLOW * min(turns, default=0.0)
    return [r for r in records if not isinstance(r, SteadyLoop) or r.frequency_hz <= most]


def _area(record: Record) -> float:
    """Return the area of a loop, of its rectangle; > 0 if the displacement lags."""
    command, displacement_um = record.command, record.displacement_um
    if isinstance(record, SteadyLoop):
        command = np.append(command, command[0])
        displacement_um = np.append(displacement_um, displacement_um[0])
    middle = 0.5 * (command[1:] + command[:-1]) - command.mean()
    box = float(np.ptp(command) * np.ptp(displacement_um))
    return float(middle @ np.diff(displacement_um)) / box
