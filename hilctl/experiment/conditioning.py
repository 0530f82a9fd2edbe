"""Conditioning before the waveform: a decaying cycle, and a rest to measure the offset at.

A cycle that starts large and decays erases the hysteresis memory, so the run does not depend on
earlier ones; the compensator starts from the state after the cycle.
"""

import math
from collections.abc import Iterator

import numpy as np

from hilctl.base.errors import ConfigProblem
from hilctl.base.types import F64
from hilctl.experiment.file import REST_S, Experiment
from hilctl.experiment.load import LoadedExperiment
from hilctl.loop.lead_in import Conditioning
from hilctl.waveforms.shapes import check_length

OFFSET_SHARE = 0.25  # largest measured offset that is corrected, as a share of the stroke limits
_HIGHEST_HZ = 10.0  # slow enough for fields to penetrate a rod
_FEWEST_SAMPLES = 20  # a shorter cycle misses its own peaks
_SLEW_SHARE = 0.5  # of the slew limit, by default


def measures_offset(config: Experiment) -> bool:
    """Return whether a run measures its resting offset to correct the compensator's input."""
    return config.compensator is not None and config.compensator.offset == "measured"


def conditioning_of(
    loaded: LoadedExperiment, stands_um: float | None = None
) -> Conditioning | None:
    """Return the conditioning before the waveform, or None; raise InputError if it is too long."""
    # stands_um: the model displacement at its end, or None if no offset is measured.
    config, condition = loaded.config, loaded.config.condition
    if condition is None and not config.zero and not measures_offset(config):
        return None
    rate_hz, block, safe = config.sample_rate_hz, config.block, config.safe.value
    cycle = np.empty(0) if condition is None else _cycle(config)
    rest_s = REST_S if condition is None else condition.rest_s
    stop = cycle.size + max(block, round(rest_s * rate_hz))
    blocks = math.ceil(stop / block) + loaded.device.info.latency_blocks
    command = np.full(blocks * block, safe)
    command[: cycle.size] = cycle
    low_um, high_um = config.limits.stroke_um
    return Conditioning(
        command=command,
        rest=((cycle.size + stop) // 2, stop),
        cycle_samples=cycle.size,
        stands_um=stands_um,
        largest_um=OFFSET_SHARE * (high_um - low_um),
        zero=config.zero,
        lead_in=config.lead_in_samples,
    )


def condition_problems(loaded: LoadedExperiment) -> Iterator[ConfigProblem]:
    """Yield the broken rules of the ``condition`` section and of ``zero``."""
    config, condition = loaded.config, loaded.config.condition
    if config.zero and measures_offset(config):
        rule = "must be false with compensator.offset: measured, which corrects the same offset"
        yield loaded.problem("zero", rule, "true")
    if condition is None:
        return
    unit = config.limits.unit
    key = f"condition.amplitude_{unit.lower()}"
    given = {"A": condition.amplitude_a, "V": condition.amplitude_v}
    if any(value is not None for other, value in given.items() if other != unit):
        rule = f"must have amplitude_{unit.lower()}: limits are in {unit}"
        yield loaded.problem("condition", rule)
    furthest = max(_room(config))
    amplitude = given[unit]
    if amplitude is not None and amplitude > furthest:
        rule = f"must be <= {furthest:g} {unit}, the distance from safe.value to the limits"
        yield loaded.problem(key, rule, f"{amplitude:g}")
    hz, highest_hz = _frequency_hz(config), _highest_hz(config)
    if hz > highest_hz:
        rule = f"must be <= {highest_hz:.4g} Hz (slew limit, {_FEWEST_SAMPLES} samples per cycle)"
        yield loaded.problem("condition.frequency_hz", rule, f"{hz:g}")


def _room(config: Experiment) -> tuple[float, float]:
    """Return the amplitudes below and above the safe value, in the command's unit."""
    condition, safe, (low, high) = config.condition, config.safe.value, config.limits.command_range
    assert condition is not None
    given = condition.amplitude_a or condition.amplitude_v or math.inf
    return min(given, safe - low), min(given, high - safe)


def _highest_hz(config: Experiment) -> float:
    slew_hz = config.limits.slew_per_s / (2.0 * math.pi * max(_room(config)))
    return min(slew_hz, config.sample_rate_hz / _FEWEST_SAMPLES)


def _frequency_hz(config: Experiment) -> float:
    assert config.condition is not None
    given = config.condition.frequency_hz
    return given or min(_HIGHEST_HZ, _SLEW_SHARE * _highest_hz(config))


def _cycle(config: Experiment) -> F64:
    """Return the commands of the cycle, float64[n]; the first period has the full amplitude."""
    condition, safe = config.condition, config.safe.value
    assert condition is not None
    below, above = _room(config)
    cycles_per_sample = _frequency_hz(config) / config.sample_rate_hz
    check_length(condition.cycles / cycles_per_sample)
    turn = cycles_per_sample * np.arange(1, round(condition.cycles / cycles_per_sample) + 1)
    wave = np.sin(2.0 * np.pi * turn)
    falling, span, decay = np.maximum(turn - 1.0, 0.0), condition.cycles - 1.0, condition.decay
    if decay == 1.0:
        envelope = 1.0 - falling / span
    else:  # shifted to end at 0; expm1, because differences of powers near 1 lose digits
        log = math.log(decay)
        envelope = decay**falling * np.expm1((span - falling) * log) / math.expm1(span * log)
    command: F64 = safe + envelope * np.where(wave > 0.0, above, below) * wave
    command[-1] = safe
    return command
