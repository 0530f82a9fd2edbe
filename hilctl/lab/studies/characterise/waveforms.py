"""Waveforms of the steps, as keys of an experiment; every part starts and ends at rest."""

import json
import math
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from pydantic import TypeAdapter

from hilctl.base.types import F64
from hilctl.experiment.template import round_hz
from hilctl.lab.studies.characterise.limits import CharacterisationLimits
from hilctl.models.base import HysteresisModel
from hilctl.waveforms.build import Reference, build
from hilctl.waveforms.spec import AnyWaveform

Keys: TypeAlias = dict[str, Any]

REST_S = 2.0
CREEP_S = 4.0
RANDOM_S = 3.0
FIRST_PARTS = (0.3, 0.1, 0.03)
"""Amplitudes of a first run through a model, of its range; the first that passes the check."""
HELD_OUT_SEED = 7
TRAINING_SEED = 100

_ADAPTER: TypeAdapter[AnyWaveform] = TypeAdapter(AnyWaveform)
_LINES_BELOW_TOP = 8.0  # lines of the small multisine within the band of loops
_TOP = 0.2  # highest line, as a share of the sample rate
_RESPONSE_S = 2.0
_PERIODS = (6, 100)
_CONDITIONING_CYCLES = 12
_RANDOM_CYCLES = 8.0
_REVERSALS = 9
_TRIES = 5
_OF_REST = 0.8
_SMALL = ((0.6, 0.35), (-0.6, 0.35), (0.0, 0.35), (0.87, 0.11), (-0.87, 0.11), (0.0, 0.11))
_FROM_REST = (
    (0.95, (0.0,)),
    (0.5, (0.45, -0.45)),
    (0.25, (0.7, -0.7)),
    (0.12, (0.85, 0.0, -0.85)),
)
"""Amplitudes of loops from rest, of the full amplitude, and their offsets."""
_FROM_REST_S = 1.0
_SETTLED = (
    (0.1, (-0.9, -0.45, 0.0, 0.45, 0.9)),
    (0.25, (-0.75, -0.375, 0.0, 0.375, 0.75)),
)
"""Amplitudes of loops that settle, of half the stroke, and their offsets from its middle."""
_MOST_COMMAND = 3.0  # largest command of a loop that settles, relative to the one in the middle
_RANDOM_BAND = (5.0, 0.5)  # times the lowest and the highest frequency of loops


def reference_of(limits: CharacterisationLimits, keys: Keys) -> Reference:
    """Return the commands of a waveform, and its segments."""
    return build(_ADAPTER.validate_json(json.dumps(keys)), limits.sample_rate_hz, Path())


def within(limits: CharacterisationLimits, keys: Keys) -> tuple[Keys, F64]:
    """Shrink a waveform towards rest until it keeps slew and heat; return keys and commands."""
    for _ in range(_TRIES):
        command = reference_of(limits, keys).values.copy()  # kernels need a writable array
        scale = limits.scale(command)
        if scale >= 1.0:
            break
        keys = _scaled(limits, keys, 0.99 * scale)
    return keys, command


def _scaled(limits: CharacterisationLimits, keys: Keys, scale: float) -> Keys:
    """Scale a waveform about rest."""
    changed = {
        key: scale * value if key in {"amplitude", "rate_per_s"} else value
        for key, value in keys.items()
    }
    if "parts" in keys:
        changed["parts"] = [_scaled(limits, part, scale) for part in keys["parts"]]
    if "levels" in keys:
        changed["levels"] = [scale * level for level in keys["levels"]]
    if "offset" in keys:
        changed["offset"] = limits.rest + scale * (keys["offset"] - limits.rest)
    return changed


def at_rest(limits: CharacterisationLimits, duration_s: float = REST_S) -> Keys:
    """Hold the safe value."""
    return {"kind": "hold", "unit": limits.unit, "level": limits.rest, "duration_s": duration_s}


def sine(
    limits: CharacterisationLimits,
    amplitude: float,
    frequency_hz: float,
    cycles: float,
    *,
    offset: float | None = None,
    soft: float = 2.0,
) -> Keys:
    """Return a sine with soft ends; its amplitude is lowered to the slew limit."""
    # ``soft`` cycles precede the ``cycles`` of full amplitude; the soft end is half as long.
    keys = {
        "kind": "sine",
        "unit": limits.unit,
        "amplitude": _rounded(limits.by_slew(amplitude, frequency_hz)),
        "frequency_hz": frequency_hz,
        "offset": limits.centre if offset is None else offset,
    }
    return _softened(limits, keys, cycles / frequency_hz, soft / frequency_hz)


def _softened(limits: CharacterisationLimits, keys: Keys, whole_s: float, soft_s: float) -> Keys:
    """Return keys with a soft start and a soft end of half its length."""
    least_s = limits.soft_s(keys["amplitude"], keys["offset"])
    start_s, end_s = max(soft_s, least_s), max(0.5 * soft_s, least_s)
    return {
        **keys,
        "rest": limits.rest,
        "duration_s": start_s + whole_s + end_s,
        "soft_start_s": start_s,
        "soft_end_s": end_s,
    }


def small_multisine(
    limits: CharacterisationLimits, amplitude: float, offset: float | None = None
) -> Keys:
    """Return a multisine far beyond the band of loops; its period is a whole number of samples."""
    wanted_hz = limits.highest_hz / _LINES_BELOW_TOP
    step_hz = limits.sample_rate_hz / round(limits.sample_rate_hz / wanted_hz)
    periods = min(max(round(_RESPONSE_S * step_hz), _PERIODS[0]), _PERIODS[1])
    keys = {
        "kind": "multisine",
        "unit": limits.unit,
        "amplitude": amplitude,
        "first_hz": step_hz,
        "last_hz": _TOP * limits.sample_rate_hz,
        "step_hz": step_hz,
        "offset": limits.beside_rest(amplitude) if offset is None else offset,
    }
    return _softened(limits, keys, periods / step_hz, 2.0 / step_hz)


def conditioning(limits: CharacterisationLimits, amplitude: float) -> Keys:
    """Return the decaying cycle that brings the actuator to the same state in every run."""
    return {
        **sine(limits, amplitude, limits.middle_hz, _CONDITIONING_CYCLES, soft=1.0),
        "kind": "decaying",
    }


def slow_loops(limits: CharacterisationLimits, amplitude: float) -> Keys:
    """Return loops at the lowest frequency, the largest first to make the others repeatable."""
    parts = [
        sine(limits, part * amplitude, limits.lowest_hz, 3.0, soft=1.0)
        for part in (1.0, 0.75, 0.5, 0.25)
    ]
    return _sequence(limits, parts)


def frequencies_hz(limits: CharacterisationLimits) -> list[float]:
    """Return the frequencies of fast loops, the highest last."""
    growth = (limits.highest_hz / limits.lowest_hz) ** 0.2
    return [round_hz(limits.lowest_hz * growth**k) for k in range(1, 5)] + [limits.highest_hz]


def fast_loops(limits: CharacterisationLimits, amplitudes: dict[float, float]) -> Keys:
    """Return loops at several frequencies, given the largest amplitude at each."""
    parts = [
        sine(limits, part * amplitude, frequency_hz, max(4.0, math.ceil(0.2 * frequency_hz)))
        for part in (1.0, 0.5, 0.2)
        for frequency_hz, amplitude in amplitudes.items()
        if part > 0.2 or frequency_hz > limits.middle_hz
    ]
    return _sequence(limits, parts)


def _conditioned(limits: CharacterisationLimits, amplitude: float, *parts: Keys) -> Keys:
    return _sequence(limits, [conditioning(limits, amplitude), *parts])


def reversal_curves(limits: CharacterisationLimits, amplitude: float) -> Keys:
    """Return first-order reversal curves with ever lower turning points, after conditioning."""
    levels = [1.0, -1.0, 1.0]
    for k in range(1, _REVERSALS + 1):
        levels += [1.0 - 2.0 * k / _REVERSALS, 1.0]
    path = {
        "kind": "path",
        "levels": [*(level * amplitude for level in levels), limits.rest - limits.centre],
        "rate_per_s": min(8.0 * amplitude * limits.lowest_hz, limits.slew_per_s),
        "offset": limits.centre,
        "rest": limits.rest,
    }
    return _conditioned(limits, amplitude, path)


def biased_loops(limits: CharacterisationLimits, amplitude: float) -> Keys:
    """Return loops of all sizes over the whole range, each from rest, after conditioning."""
    # A run starts from rest: what relaxes there is an offset of its first cycles, which motions
    # that follow each other do not have.
    parts = []
    for hz in (limits.middle_hz, _RANDOM_BAND[1] * limits.highest_hz):
        for size, places in _FROM_REST:
            for place in places:
                offset = limits.centre + place * amplitude
                loop = sine(limits, size * amplitude, hz, 4.0, offset=offset, soft=1.0)
                parts += [at_rest(limits, _FROM_REST_S), loop]
    return _conditioned(limits, amplitude, *parts)


def settled_loops(limits: CharacterisationLimits, amplitude: float, line: F64) -> Keys:
    """Return small loops of two sizes and frequencies up to both ends, after conditioning.

    ``line`` are commands at even steps of the displacement over the whole stroke, float64[k].
    """
    # A small loop drifts in its first cycles, and random motions do not show where it settles. As
    # in a run, it starts within a cycle, so the path to it sets the offset of its first cycle.
    stroke = np.linspace(-1.0, 1.0, line.size)
    parts = []
    for hz in (limits.middle_hz, _RANDOM_BAND[1] * limits.highest_hz):
        for size, places in _SETTLED:
            ends = [np.interp([at - size, at + size], stroke, line).tolist() for at in places]
            middle = ends[len(ends) // 2]
            most = _MOST_COMMAND * (middle[1] - middle[0])
            # One fit cannot have the densities of a loop in saturation and those of all others.
            parts += [
                sine(limits, 0.5 * (high - low), hz, 4.0, offset=0.5 * (low + high), soft=1.0)
                for low, high in ends
                if high - low <= most
            ]
    return _conditioned(limits, amplitude, *parts)


def random_reference(limits: CharacterisationLimits, amplitude: float, seed: int) -> Keys:
    """Return an aperiodic reference, after conditioning."""
    part = _random_part(limits, amplitude, seed, RANDOM_S, limits.centre)
    return _conditioned(limits, amplitude, part)


def rests(limits: CharacterisationLimits, amplitude: float) -> Keys:
    """Return holds at both ends and at rest for creep, after conditioning."""
    level = _OF_REST * amplitude
    rate_per_s = min(8.0 * amplitude * limits.lowest_hz, limits.slew_per_s)
    rise_s = min(2.0 * level / rate_per_s, 0.5 * CREEP_S)
    steps = {
        "kind": "step",
        "levels": [level, -level, limits.rest - limits.centre],
        "dwell_s": CREEP_S,
        "rise_s": rise_s,
        "offset": limits.centre,
        "rest": limits.rest,
    }
    return _conditioned(limits, amplitude, steps)


def _random_part(
    limits: CharacterisationLimits, amplitude: float, seed: int, least_s: float, offset: float
) -> Keys:
    first_hz, last_hz = _RANDOM_BAND[0] * limits.lowest_hz, _RANDOM_BAND[1] * limits.highest_hz
    part = {
        "kind": "random",
        "unit": limits.unit,
        "amplitude": _rounded(amplitude),
        "first_hz": min(first_hz, 0.5 * last_hz),
        "last_hz": last_hz,
        "seed": seed,
        "offset": offset,
    }
    seconds = max(least_s, _RANDOM_CYCLES / limits.middle_hz)
    part, _ = within(limits, _softened(limits, part, seconds, 1.0 / limits.middle_hz))
    return part


def small_motions(limits: CharacterisationLimits, amplitude: float) -> Keys:
    """Return small aperiodic motions of two sizes over the whole range, after conditioning."""
    # They identify what large loops do not excite, especially near the ends of the range.
    parts = (
        _random_part(limits, size * amplitude, seed, 0.5 * RANDOM_S, limits.centre + at * amplitude)
        for seed, (at, size) in enumerate(_SMALL, TRAINING_SEED + 1)
    )
    return _conditioned(limits, amplitude, *parts)


def first_run(limits: CharacterisationLimits, model: HysteresisModel, part: float) -> Keys:
    """Return a sine in um about the middle of a model's range, with a part of it as amplitude."""
    low_um, high_um = model.output_range_um or limits.stroke_um
    soft_s = max(2.0 / limits.middle_hz, limits.soft_s(limits.reach, limits.centre))
    soft_s = _rounded(soft_s)
    return {
        "kind": "sine",
        "unit": "um",
        "amplitude": _rounded(part * (high_um - low_um)),
        "offset": _rounded(0.5 * (low_um + high_um)),
        "frequency_hz": limits.middle_hz,
        "duration_s": _rounded(soft_s + 8.0 / limits.middle_hz),
        "soft_start_s": soft_s,
    }


def _rounded(amplitude: float) -> float:
    """Return an amplitude rounded to four digits; limits have a larger margin."""
    return float(f"{amplitude:.4g}")


def _sequence(limits: CharacterisationLimits, parts: list[Keys]) -> Keys:
    return {"kind": "sequence", "unit": limits.unit, "parts": parts}
