"""Faults of measured data: units, wiring, spikes, steps, late triggers, transients, clipping."""

from collections.abc import Iterator, Sequence

import numpy as np
from scipy.fft import irfft, next_fast_len, rfft
from scipy.ndimage import black_tophat, maximum_filter1d, median_filter, white_tophat

from hilctl.base.types import F64
from hilctl.kernels.hysteresis import play_outputs, rest_memory
from hilctl.lab.identify.data.records import (
    History,
    Record,
    SteadyLoop,
    from_known_state,
    turning_points,
)
from hilctl.lab.identify.settings import FitSettings

AGAINST = -0.3  # correlation of command and displacement with the wrong sign
LEADING = -0.02  # area of a loop, of its rectangle, whose displacement leads the command
MOST_UM = 5000.0
APART = 30.0  # maximum ratio of the gains of records of one actuator
SLOW = 1.5  # of the lowest frequency: loops whose phase is due to hysteresis, not delay
SPIKE = 20.0  # ratio of a spike to what 99 % of the samples differ from their neighbours
SPIKE_ROWS, SPIKE_AROUND = 2, 9  # most samples of a small spike; samples that it is compared with
MOST_NAMED = 5  # spikes in a message
APART_FROM_OTHERS = 3.0  # ratio of a single step to all other differences of neighbours
KINK = 2.0  # smallest ratio of a step to the steps of the samples beside it
SPIKE_STROKE = 0.02  # smallest spike or step, of the stroke of all other samples
JUMP = 0.05  # of the command's range: a step of the command is no fault
CLIPPED, FEWEST_CLIPPED = 0.05, 5  # motion of the command, of its range, and samples at one value
LARGE = 0.1  # of the largest swing: smaller ones are ignored
DEAD, FEWEST_DEAD = 0.1, 2  # of the usual displacement per command; swings in a row
UNLIKE, UNLIKE_STROKE = 3.0, 0.05  # smallest error at the start: of that in the second half, stroke
LIKE = 1.5  # of the error in the second half: the start has ended
PLAYS, MOST_SAMPLES, TURNS = 8, 200_000, 8  # of the plain model that shows a start
ALIGNED, SHIFTED = 0.7, 0.9  # largest correlation as recorded, and smallest if shifted in time
LATE_S, LATEST = 0.02, 0.25  # shortest lag that is not of the device, longest of the record
MOVES = 0.2  # of the stroke, during a constant command


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
            "the displacement falls when the command rises: swap the wires of the coil, invert "
            "the sign of the sensor (--displacement-scale -1 for a table), or correct the timing "
            "if a table is late by half a cycle (--set table.lag_samples)"
        )
    elif along > 0.0 and float(np.median([_area(record) for record in slow])) < LEADING:
        yield (
            "the displacement leads the command: swap the columns of command and displacement, or "
            "correct their timing (of a table with --set table.lag_samples)"
        )


def record_fault(record: Record, settings: FitSettings) -> str:
    """Return the fault of single samples or of a part of a record, and its cure; or empty."""
    return (
        _still(record)
        or _spikes(record)
        or _step(record)
        or _clipped(record)
        or _far_from_zero(record, settings)
    )


def table_fault(history: History, *, start: bool = True) -> str:
    """Return the fault of a table that spoils any fit, with its time and cure; or empty.

    ``start`` also compares the start with the rest. Samples that no fit evaluates are not checked.
    """
    known = from_known_state(history)
    return (
        _held_command(history)
        or _still(known)
        or _spikes(known)
        or _step(known)
        or _shifted(history)
        or (_start(known) if start else "")
    )


def _spikes(record: Record) -> str:
    """Return a message on a few samples that differ from all their neighbours."""
    first, y, u = _first(record), record.displacement_um, record.command
    low_um, high_um = np.percentile(y[first:], [1.0, 99.0])
    outside = np.maximum(y - high_um, low_um - y) > high_um - low_um
    size = (SPIKE_ROWS + 1,)
    off = np.maximum(white_tophat(y, size), black_tophat(y, size))
    # A ramp before a step, or a kink, differs by that many steps.
    around_um = median_filter(np.abs(np.gradient(y)), SPIKE_AROUND, mode="nearest")
    least_um = np.maximum(
        max(SPIKE * np.percentile(off[first:], 99.0), SPIKE_STROKE * (high_um - low_um)),
        (SPIKE_ROWS + 0.5) * around_um,
    )
    # A step of the command excites the structure.
    steps = maximum_filter1d(np.abs(np.diff(u, prepend=u[0])), 2 * SPIKE_AROUND + 1)
    still = steps <= JUMP * np.ptp(u)
    found = first + np.flatnonzero((outside | (still & (off > least_um)))[first:])
    if not found.size:
        return ""
    named = ", ".join(f"{y[at]:.4g} µm at {_place(record, at)}" for at in found[:MOST_NAMED])
    more = f" and {found.size - MOST_NAMED} more" if found.size > MOST_NAMED else ""
    in_table = isinstance(record, History) and record.rows.size
    cure = "remove these values (NaN or an empty cell)" if in_table else "measure again"
    return f"has spikes: {named}{more}: {cure}"


def _step(record: Record) -> str:
    """Return a message on a step that differs from its neighbours more than all others do."""
    first = _first(record)
    y, u = record.displacement_um[first:], record.command[first:]
    off = np.abs(y[1:-1] - 0.5 * (y[2:] + y[:-2]))
    at = int(np.argmax(off)) + 1
    stays_um = float(y[at + 1] - y[at - 1])
    # At a kink of the displacement, the samples beside it differ as much.
    beside_um = max(np.ptp(y[max(at - 2, 0) : at]), np.ptp(y[at + 1 : at + 3]))
    # In noise, 99 % of the samples are far below the largest one.
    others_um = np.max(np.delete(off, slice(max(at - 3, 0), at + 2)), initial=0.0)
    usual_um = min(SPIKE * float(np.percentile(off, 99.0)), APART_FROM_OTHERS * others_um)
    least_um = max(usual_um, KINK * beside_um)
    is_step = abs(stays_um) > max(off[at - 1], SPIKE_STROKE * float(np.ptp(np.delete(y, at))))
    if not is_step or off[at - 1] <= least_um or abs(u[at + 1] - u[at - 1]) > JUMP * np.ptp(u):
        return ""
    at += abs(y[at + 1] - y[at]) > abs(y[at] - y[at - 1])  # the first sample after the step
    at += first
    size = record.command.size
    cure = _without(record, *((0, at) if at < size // 2 else (at, size)))
    return f"has a step of {stays_um:.3g} µm at {_place(record, at)}{cure}"


def _held_command(history: History) -> str:
    """Return a message if the displacement moves before the command does."""
    moves = np.flatnonzero(history.command != history.command[0])
    start = int(moves[0]) if moves.size else 0
    before_um, y = history.displacement_um[:start], history.displacement_um
    if before_um.size == 0 or np.ptp(before_um) < MOVES * np.ptp(y):
        return ""
    return (
        f"moves by {np.ptp(before_um):.3g} µm before the command changes at "
        f"{_place(history, start)}: its channel was triggered late. Use the rows after it with "
        f"--set table.first_row={_row(history, start)}"
    )


def _shifted(history: History) -> str:
    """Return a message if the displacement is that of another time, as after a late trigger."""
    u, y = (each - each.mean() for each in (history.command, history.displacement_um))
    size = next_fast_len(2 * u.size, real=True)
    alike = irfft(np.conj(rfft(u, size)) * rfft(y, size), size) / np.sqrt((u @ u) * (y @ y))
    longest = int(LATEST * u.size)
    lags = np.arange(-longest, longest + 1)
    lag = int(lags[np.argmax(alike[lags])])
    lag_s = lag / history.sample_rate_hz
    if alike[0] > ALIGNED or alike[lag] < max(SHIFTED, -alike[0]) or abs(lag_s) < LATE_S:
        return ""
    where = "after" if lag > 0 else "before"
    return (
        f"follows the command best if it is taken from about {abs(lag_s):.3g} s {where} it: one of "
        f"them was triggered late. Shift it with --set table.lag_samples={lag}, adjusted to the "
        "times of the triggers"
    )


def _start(history: History) -> str:
    """Return a message if the start departs from a plain model of the rest, as a transient does.

    The model has plays, rate and acceleration; it is fitted to the rest until the start ends.
    """
    step = history.command.size // MOST_SAMPLES + 1
    u, y = (
        np.ascontiguousarray(each[::step]) for each in (history.command, history.displacement_um)
    )
    first, half = history.ignore // step, u.size // 2
    plays, rate = np.empty((u.size, PLAYS)), np.gradient(u)
    thresholds = 0.5 * np.ptp(u) * np.arange(PLAYS) / PLAYS
    centred = u - 0.5 * (u.max() + u.min())
    play_outputs(centred, np.zeros(u.size), thresholds, rest_memory(PLAYS), plays)
    columns = np.column_stack((np.ones(u.size), plays, rate, np.gradient(rate)))
    columns /= np.maximum(np.abs(columns).max(axis=0), np.finfo(np.float64).tiny)
    begin, peak_um = first, 0.0
    for _ in range(TURNS):
        off_um = np.abs(y - columns @ np.linalg.lstsq(columns[begin:], y[begin:])[0])
        usual_um, start_um = float(off_um[half:].max()), off_um[begin:half]
        if start_um.max(initial=0.0) <= max(UNLIKE * usual_um, UNLIKE_STROKE * np.ptp(y[half:])):
            break
        peak_um = max(peak_um, float(start_um.max()))
        begin += int(np.flatnonzero(start_um > LIKE * usual_um)[-1]) + 1
    if begin == first:
        return ""
    return (
        f"departs by up to {peak_um:.3g} µm from the motion of the rest until "
        f"{_place(history, begin * step)}{_without(history, 0, begin * step)}, or all rows with "
        "--set table.ignore=0"
    )


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
    large = large[turns[large] >= record.ignore]
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
    kind = "row" if record.rows.size else "sample"
    return f"{record.time_s[at]:.4g} s ({kind} {_row(record, at)})"


def _row(history: History, at: int) -> int:
    return int(history.rows[at]) if history.rows.size else at + 1


def _first(record: Record) -> int:
    """Return the first evaluated sample."""
    return record.ignore if isinstance(record, History) else 0


def _without(record: Record, start: int, stop: int) -> str:
    """Return how to identify without the samples from ``start`` to ``stop``."""
    if not (isinstance(record, History) and record.rows.size):
        return ", and measure again"
    if start > record.command.size - stop:
        return f". Use the rows before it with --set table.last_row={record.rows[start] - 1}"
    return f". Use the rows after it with --set table.ignore={stop}"


def _far_from_zero(record: Record, settings: FitSettings) -> str:
    """Return a message if the displacement has an offset that the model lacks."""
    if settings.fit.has_offset or settings.looks_for("offset") or settings.creep:
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
