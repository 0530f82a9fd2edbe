"""Interlocks on the samples of a run: all of them in one pass, with memory between blocks.

Settings and memory are arrays with a named index for each number, so one call per block is enough;
see :class:`hilctl.loop.interlocks.Interlocks` for their meaning. A time is a whole number of
samples; an infinite one disables its interlock.
"""

from enum import IntFlag

from hilctl.base.samples import Flag
from hilctl.base.types import F64, U32
from hilctl.kernels.jit import kernel


class InterlockFlag(IntFlag):
    """Bits of a sample's ``flags`` from 64 on; :class:`hilctl.base.samples.Flag` has the others."""

    SENSOR_FROZEN = 64
    """The displacement had not changed for too long while the command moved."""
    DEVIATION = 128
    """The measured command was too far from the applied one for too long, or was lost."""
    THERMAL = 256
    """The thermal budget of the coil was used up."""
    TRACKING_ERROR = 512
    """The displacement was too far from the reference for too long."""
    AUX = 1024
    """An auxiliary channel was outside its limits, or missing for too long; checked per block."""
    APART = 2048
    """The displacements of two axes differed by too much for too long."""


(
    STROKE_LOW, STROKE_HIGH, RAIL_LOW, RAIL_HIGH, FROZEN_UM, FROZEN_TRAVEL, FROZEN_SAMPLES,
    DEVIATION, DEVIATION_SAMPLES, WARMING, BUDGET, TRACKING_UM, TRACKING_SAMPLES, MISSING_SAMPLES,
) = range(14)  # fmt: skip
SETTINGS = 14

(
    COMMAND, READING, LOWEST, HIGHEST, FROZEN_RUN, DEVIATION_RUN, HEAT, TRACKING_RUN, MISSING_RUN,
) = range(9)  # fmt: skip
MEMORY = 9

_INVALID = int(Flag.SENSOR_INVALID)
_FROZEN = int(InterlockFlag.SENSOR_FROZEN)
_DEVIATION = int(InterlockFlag.DEVIATION)
_THERMAL = int(InterlockFlag.THERMAL)
_TRACKING = int(InterlockFlag.TRACKING_ERROR)
_APART = int(InterlockFlag.APART)


@kernel(inline=True)
def _invalid(displacement_um: float, settings: F64) -> int:
    """Return the flag of a reading outside the stroke or at an end of the sensor's range."""
    within = settings[STROKE_LOW] <= displacement_um <= settings[STROKE_HIGH]
    seen = settings[RAIL_LOW] < displacement_um < settings[RAIL_HIGH]
    return 0 if within and seen else _INVALID


@kernel(inline=True)
def _frozen(displacement_um: float, command: float, settings: F64, memory: F64) -> int:
    """Count the samples with a constant reading after the command has travelled.

    The count starts when the travel is sufficient, so a constant command of any duration, or a step
    after it, does not look like a dead sensor.
    """
    reading, run = memory[READING], memory[FROZEN_RUN]
    low, high = min(memory[LOWEST], command), max(memory[HIGHEST], command)
    if not abs(displacement_um - reading) <= settings[FROZEN_UM]:
        reading, low, high, run = displacement_um, command, command, 0.0
    if high - low > settings[FROZEN_TRAVEL]:
        run += 1.0
    memory[READING], memory[FROZEN_RUN] = reading, run
    memory[LOWEST], memory[HIGHEST] = low, high
    return _FROZEN if run > settings[FROZEN_SAMPLES] else 0


@kernel(inline=True)
def _deviating(measured: float, command: float, settings: F64, memory: F64) -> int:
    """Count the samples with a deviation of the measured command.

    A reading may be taken before or after its command takes effect, so it is compared with the span
    of this command and the previous one. NaN always deviates.
    """
    previous, away = memory[COMMAND], settings[DEVIATION]
    low, high = min(previous, command) - away, max(previous, command) + away
    run = memory[DEVIATION_RUN] + 1.0
    if low <= measured <= high:
        run = 0.0
    memory[DEVIATION_RUN] = run
    return _DEVIATION if run > settings[DEVIATION_SAMPLES] else 0


@kernel(inline=True)
def _warmed(heat: float, command: float, measured: float, warming: float) -> float:
    """Advance d(heat)/dt = (current^2 - heat) / tau by one sample of constant current."""
    load = command * command
    if load < measured * measured < float("inf"):  # a value that is not finite was not measured
        load = measured * measured
    return heat + (load - heat) * warming


@kernel(inline=True)
def _too_hot(command: float, measured: float, settings: F64, memory: F64) -> int:
    heat = _warmed(memory[HEAT], command, measured, settings[WARMING])
    memory[HEAT] = heat
    return _THERMAL if heat > settings[BUDGET] else 0


@kernel(inline=True)
def _off_track(reference: float, displacement_um: float, settings: F64, memory: F64) -> int:
    """Count the samples with too large an error; a sample without a reference (NaN) has none."""
    run = memory[TRACKING_RUN] + 1.0
    if not abs(reference - displacement_um) > settings[TRACKING_UM]:
        run = 0.0
    memory[TRACKING_RUN] = run
    return _TRACKING if run > settings[TRACKING_SAMPLES] else 0


@kernel()
def interlock_block(
    settings: F64,
    memory: F64,
    command: F64,
    reference: F64,
    displacement_um: F64,
    measured: F64,
    flags: U32,
) -> int:
    """Check a block of samples against all interlocks; return the index of the first trip, or -1.

    A missing reading (NaN) is flagged, and trips if too many follow one another. It neither ends
    nor continues the time of the other conditions on readings.

    Signals are float64[n]: command and measured command in A or V, the others in um; a missing
    reference or measured command is NaN. The bits of invalid readings and of each tripped interlock
    are added to ``flags``. ``settings`` is float64[14], ``memory`` float64[9], updated in place;
    any division into blocks gives the same bits.
    """
    first = -1
    for k in range(command.size):
        trips = _deviating(measured[k], command[k], settings, memory)
        trips |= _too_hot(command[k], measured[k], settings, memory)
        if displacement_um[k] == displacement_um[k]:
            memory[MISSING_RUN] = 0.0
            trips |= _invalid(displacement_um[k], settings)
            trips |= _frozen(displacement_um[k], command[k], settings, memory)
            trips |= _off_track(reference[k], displacement_um[k], settings, memory)
        else:
            memory[MISSING_RUN] += 1.0
            flags[k] |= _INVALID
            if memory[MISSING_RUN] > settings[MISSING_SAMPLES]:
                trips |= _INVALID
        memory[COMMAND] = command[k]
        flags[k] |= trips
        if first < 0 < trips:
            first = k
    return first


@kernel()
def apart_block(
    most_um: float,
    samples: float,
    run: F64,
    first_um: F64,
    second_um: F64,
    first_flags: U32,
    second_flags: U32,
) -> int:
    """Compare the displacements of two axes; return the index of the first trip, or -1.

    It trips if they are more than ``most_um`` apart in more than ``samples`` consecutive samples,
    counted in ``run``, float64[1]. A sample without both readings (NaN) does not count.
    Displacements are float64[n]; the bit of each tripped sample is added to the flags of both axes,
    uint32[n].
    """
    first = -1
    for k in range(first_um.size):
        apart_um = abs(first_um[k] - second_um[k])
        if apart_um == apart_um:
            run[0] = run[0] + 1.0 if apart_um > most_um else 0.0
            if run[0] > samples:
                first_flags[k] |= _APART
                second_flags[k] |= _APART
                if first < 0:
                    first = k
    return first


@kernel()
def heat_block(command: F64, warming: float, heat: float, out: F64) -> float:
    """Fill ``out`` with the heat of a coil after each command, as :func:`interlock_block` does.

    ``command`` is float64[n], in A; ``warming`` is 1 - exp(-dt / tau), ``heat`` the heat before the
    block, in A^2. Return the heat after it.
    """
    for k in range(command.size):
        heat = _warmed(heat, command[k], command[k], warming)
        out[k] = heat
    return heat
