"""The ``condition`` section and ``zero``: a decaying cycle, and a rest to measure the offset at.

A cycle that starts large and decays erases the hysteresis memory, so the run does not depend on
earlier ones; the compensator starts from the state after the cycle.
"""

import math
from collections.abc import Iterator
from typing import Annotated

import numpy as np

from hilctl.base.errors import ConfigProblem, broken
from hilctl.base.strict import Field, StrictModel
from hilctl.base.types import F64
from hilctl.experiment.rig import RunRig
from hilctl.loop.lead_in import Conditioning
from hilctl.waveforms.shapes import check_length

REST_S = 0.1  # default rest before the waveform
OFFSET_SHARE = 0.25  # largest measured offset that is corrected, as a share of the stroke limits
_HIGHEST_HZ = 10.0  # slow enough for fields to penetrate a rod
_FEWEST_SAMPLES = 20  # a shorter cycle misses its own peaks
_SLEW_SHARE = 0.5  # of the slew limit, by default


class Condition(StrictModel):
    """A decaying cycle around the safe value before the waveform, for a repeatable initial state.

    Attributes:
        amplitude_a: Amplitude of the first cycle, for devices driven in A, cut off at the limits.
            Default: up to the limits.
        amplitude_v: The same for devices driven in V.
        frequency_hz: Frequency. Default: 10 Hz, or less if the slew limit or the sample rate
            requires it.
        cycles: Number of cycles.
        decay: Ratio of the amplitudes of consecutive cycles; 1 for a linear decay.
        rest_s: Rest at the safe value after it; its second half gives the mean displacement.
    """

    amplitude_a: Annotated[float, Field(gt=0.0)] | None = None
    amplitude_v: Annotated[float, Field(gt=0.0)] | None = None
    frequency_hz: Annotated[float, Field(gt=0.0)] | None = None
    cycles: Annotated[int, Field(ge=2, le=1000)] = 20
    decay: Annotated[float, Field(ge=0.1, le=1.0)] = 0.8
    rest_s: Annotated[float, Field(ge=0.0, le=60.0)] = REST_S


def make_conditioning(
    condition: Condition | None,
    rig: RunRig,
    *,
    zero: bool,
    offset: bool,
    stands_um: float | None = None,
) -> Conditioning | None:
    """Return the conditioning before the waveform, or None; raise InputError if it is too long.

    ``zero`` and ``offset`` tell whether the run measures one at rest. ``stands_um`` is the model's
    displacement at the end of the conditioning; None if nothing is measured.
    """
    if condition is None and not zero and not offset:
        return None
    rate_hz, block, latency_blocks = rig.exchange
    cycle = np.empty(0) if condition is None else _cycle(condition, rig)
    rest_s = REST_S if condition is None else condition.rest_s
    stop = cycle.size + max(block, round(rest_s * rate_hz))
    blocks = math.ceil(stop / block) + latency_blocks
    command = np.full(blocks * block, rig.command.safe)
    command[: cycle.size] = cycle
    low_um, high_um = rig.stroke_um
    return Conditioning(
        command=command,
        rest=((cycle.size + stop) // 2, stop),
        cycle_samples=cycle.size,
        stands_um=stands_um,
        largest_um=OFFSET_SHARE * (high_um - low_um),
        zero=zero,
        lead_in=rig.lead_in_samples,
    )


def zero_problems(*, zero: bool, offset: bool) -> Iterator[ConfigProblem]:
    """Yield that a run with a measured offset has ``zero`` as well."""
    if zero and offset:
        rule = "must be false with compensator.offset: measured, which corrects the same offset"
        yield broken("zero", rule, "true")


def condition_problems(condition: Condition | None, rig: RunRig) -> Iterator[ConfigProblem]:
    """Yield the broken rules of the ``condition`` section."""
    if condition is None:
        return
    unit = rig.unit
    key = f"condition.amplitude_{unit.lower()}"
    given = {"A": condition.amplitude_a, "V": condition.amplitude_v}
    if any(value is not None for other, value in given.items() if other != unit):
        rule = f"must have amplitude_{unit.lower()}: limits are in {unit}"
        yield broken("condition", rule)
    furthest = max(_room(condition, rig))
    amplitude = given[unit]
    if amplitude is not None and amplitude > furthest:
        rule = f"must be <= {furthest:g} {unit}, the distance from safe.value to the limits"
        yield broken(key, rule, f"{amplitude:g}")
    hz, highest_hz = _frequency_hz(condition, rig), _highest_hz(condition, rig)
    if hz > highest_hz:
        rule = f"must be <= {highest_hz:.4g} Hz (slew limit, {_FEWEST_SAMPLES} samples per cycle)"
        yield broken("condition.frequency_hz", rule, f"{hz:g}")


def _room(condition: Condition, rig: RunRig) -> tuple[float, float]:
    """Return the amplitudes below and above the safe value, in the command's unit."""
    safe, given = rig.command.safe, condition.amplitude_a or condition.amplitude_v or math.inf
    return min(given, safe - rig.command.low), min(given, rig.command.high - safe)


def _highest_hz(condition: Condition, rig: RunRig) -> float:
    slew_hz = rig.command.slew_per_s / (2.0 * math.pi * max(_room(condition, rig)))
    return min(slew_hz, rig.exchange.rate_hz / _FEWEST_SAMPLES)


def _frequency_hz(condition: Condition, rig: RunRig) -> float:
    usual_hz = min(_HIGHEST_HZ, _SLEW_SHARE * _highest_hz(condition, rig))
    return condition.frequency_hz or usual_hz


def _cycle(condition: Condition, rig: RunRig) -> F64:
    """Return the commands of the cycle, float64[n]; the first period has the full amplitude."""
    below, above = _room(condition, rig)
    cycles_per_sample = _frequency_hz(condition, rig) / rig.exchange.rate_hz
    check_length(condition.cycles / cycles_per_sample)
    turn = cycles_per_sample * np.arange(1, round(condition.cycles / cycles_per_sample) + 1)
    wave = np.sin(2.0 * np.pi * turn)
    falling, span, decay = np.maximum(turn - 1.0, 0.0), condition.cycles - 1.0, condition.decay
    if decay == 1.0:
        envelope = 1.0 - falling / span
    else:  # shifted to end at 0; expm1, because differences of powers near 1 lose digits
        log = math.log(decay)
        envelope = decay**falling * np.expm1((span - falling) * log) / math.expm1(span * log)
    command: F64 = rig.command.safe + envelope * np.where(wave > 0.0, above, below) * wave
    command[-1] = rig.command.safe
    return command
