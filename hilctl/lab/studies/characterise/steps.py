"""Steps of a characterisation: waveform and evaluation of each run, in order."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import NoReturn, TypeAlias

import numpy as np

from hilctl.lab.studies.characterise import waveforms
from hilctl.lab.studies.characterise.limits import CharacterisationLimits as Limits
from hilctl.lab.studies.characterise.measurements import (
    RigProblemError,
    all_loops,
    centre_line,
    crept_percent,
    local_resonances,
    loop_metrics,
    next_amplitude,
    noise_at_rest,
    repeatability,
    reversal_curves,
    sine_reaction,
    small_signal,
)
from hilctl.lab.studies.characterise.results import Measured
from hilctl.lab.studies.characterise.waveforms import Keys
from hilctl.recording.recording import Recording

POLARITY_PARTS = (0.01, 0.03, 0.1)
SMALL_PARTS = (0.05, 0.25)
RESPONSE_PLACES = (-0.7, 0.0, 0.7)
"""Parts of the full amplitude. The response is measured at those away from the first one's."""
GROWING_PARTS = (0.1, 0.25, 0.5, 0.75, 1.0)

_RANDOM_PART = 0.95
_CYCLES = 12.0
_LOUD_PERCENT = 5.0  # rms noise, of the whole stroke, that hides any motion
_LEAST_MOTION = 6.0  # peak-to-peak displacement of the largest loop, over the rms noise
_LEAST_COHERENCE = 0.5  # median of the small-signal response
_FEW_LINES = 0.25  # share of the lines above the noise: a larger amplitude is tried
_CLEAR_OF_BAND = 1.5
_SAFE_OF_RESONANCE = 3.0
_MOST_SCATTER_PERCENT = 5.0

Waveform: TypeAlias = Callable[[Limits, Measured], Keys | None]
Evaluated: TypeAlias = tuple[Measured, str]
Evaluate: TypeAlias = Callable[[Recording, Limits, Measured], Evaluated]


@dataclass(frozen=True, slots=True)
class CharacterisationStep:
    """One run."""

    name: str  # name of the step and of its recording
    purpose: str
    waveform: Waveform  # returns the keys of its waveform; None if the step is not needed
    take: Evaluate  # evaluates its recording; returns all measurements so far, and a summary line


def full_amplitude(limits: Limits, measured: Measured) -> float:
    """Return the largest amplitude reached; the largest allowed one before the growing loops."""
    return measured.growing[-1].amplitude if measured.growing else limits.reach


def _at_full(build: Callable[[Limits, float], Keys]) -> Waveform:
    return lambda limits, measured: build(limits, full_amplitude(limits, measured))


def _random(seed: int) -> Waveform:
    return _at_full(
        lambda limits, full: waveforms.random_reference(limits, _RANDOM_PART * full, seed)
    )


def _unevaluated(text: str) -> Evaluate:
    """Return the evaluation of a recording that only the model uses."""
    return lambda recording, limits, measured: (measured, text)


def _take_rest(recording: Recording, limits: Limits, measured: Measured) -> Evaluated:
    found = noise_at_rest(recording)
    assert found is not None
    text = f"noise {found.noise_um:.3g} µm rms, drift {found.drift_um_per_s:+.2g} µm/s"
    return replace(measured, rest=found), text


def _polarity(part: float, limits: Limits, measured: Measured) -> Keys | None:
    if measured.reaction is not None and measured.reaction.clear:
        return None
    amplitude = part * limits.reach
    offset = limits.beside_rest(amplitude)
    return waveforms.sine(limits, amplitude, limits.middle_hz, _CYCLES, offset=offset)


def _take_polarity(recording: Recording, limits: Limits, measured: Measured) -> Evaluated:
    found = sine_reaction(recording)
    after = replace(measured, reaction=found)
    percent = 100.0 * found.amplitude / limits.reach
    gain = f"{found.gain_um:.3g} µm/{limits.unit} at {percent:.2g} % of the range"
    if found.clear and not found.even:
        if found.gain_um < 0.0:
            raise RigProblemError(
                "wrong_polarity",
                f"the displacement falls as the command rises, {gain}",
                "swap the wires of the coil or the sensor, or invert the sensor's scale in the "
                "device profile",
            )
        return after, gain
    if found.amplitude > 0.9 * POLARITY_PARTS[-1] * limits.reach:
        if found.even:
            raise RigProblemError(
                "no_bias",
                "the displacement responds alike to both signs of the command "
                f"({found.second_um:.3g} µm at twice its frequency, {found.motion_um:.3g} µm at "
                "its frequency)",
                "apply a bias magnet or bias current, or record loops and use 'hilctl identify "
                "--model butterfly'",
            )
        _refuse_silent(measured, limits, found.amplitude, percent)
    return after, f"no clear response at {percent:.2g} % of the range"


def _refuse_silent(
    measured: Measured, limits: Limits, amplitude: float, percent: float
) -> NoReturn:
    noise_um = measured.rest.noise_um if measured.rest else 0.0
    sine = f"a sine of {amplitude:.3g} {limits.unit}, {percent:.2g} % of the range"
    share = 100.0 * noise_um / (limits.stroke_um[1] - limits.stroke_um[0])
    if share > _LOUD_PERCENT:
        raise RigProblemError(
            "noise",
            f"noise is larger than the motion: {noise_um:.3g} µm rms at rest, {share:.0f} % of the "
            f"allowed stroke, hides the response to {sine}",
            "check the sensor's grounding, shielding and range",
        )
    raise RigProblemError(
        "no_reaction",
        f"no response to {sine}, above {noise_um:.3g} µm rms of noise",
        "check that the amplifier is on and enabled, the coil's wiring, and the sensor's alignment",
    )


def _response(part: float, limits: Limits, measured: Measured) -> Keys | None:
    if measured.small is not None:
        return None
    return waveforms.small_multisine(limits, part * limits.reach)


def _take_response(recording: Recording, limits: Limits, measured: Measured) -> Evaluated:
    tried = 0.5 * float(np.ptp(recording.samples.command))
    largest = tried > 0.9 * SMALL_PARTS[-1] * limits.reach
    part = f"at {100.0 * tried / limits.reach:.2g} % of the range"
    try:
        found = small_signal(recording)
    except RigProblemError as error:
        if error.code != "noise" or largest:
            raise
        return measured, f"below the noise {part}"
    coherence = float(np.median(found.coherence))
    shown = found.frequency_hz.size / found.excited_lines
    if not largest and coherence < _LEAST_COHERENCE:
        # A guide with friction hardly moves, or by stick and slip.
        return measured, f"coherence {coherence:.2g} {part}"
    if not largest and shown < _FEW_LINES:
        return measured, f"{100.0 * shown:.0f} % of the lines are above the noise {part}"
    natural_hz = found.natural_hz
    delay = f"delay {1e3 * found.delay_s:.3g} ms, lag {1e3 * found.lag_s:.3g} ms"
    text = f"gain {found.gain_um:.3g} µm/{limits.unit}, {delay}"
    if natural_hz is None:
        return replace(measured, small=found), f"{text}, no resonance"
    places = local_resonances(recording, found)
    if natural_hz < _CLEAR_OF_BAND * limits.highest_hz:
        band = f"{limits.lowest_hz:g} to {limits.highest_hz:g} Hz"
        raise RigProblemError(
            "resonance",
            f"the resonance at {natural_hz:.4g} Hz (damping {found.damping_ratio:.2g}) is within "
            f"or just above the band of the loops, {band}",
            f"set --highest-hz {natural_hz / _SAFE_OF_RESONANCE:.2g} or less, or stiffen the load",
        )
    text += f", resonance {natural_hz:.4g} Hz, damping {found.damping_ratio:.2g}"
    text += "".join(f"; {mode.natural_hz:.4g} Hz" for mode in found.further)
    return replace(measured, small=found, resonances=places), text


def _placed_response(part: float, limits: Limits, measured: Measured) -> Keys | None:
    small, full = measured.small, full_amplitude(limits, measured)
    if small is not None and not measured.resonances:
        return None
    amplitude = small.amplitude if small else SMALL_PARTS[0] * limits.reach
    places = {each: limits.centre + each * full for each in RESPONSE_PLACES}
    first = limits.beside_rest(amplitude)
    if part == min(places, key=lambda each: abs(places[each] - first)):
        return None
    return waveforms.small_multisine(limits, amplitude, places[part])


def _take_placed_response(recording: Recording, limits: Limits, measured: Measured) -> Evaluated:
    try:
        found = local_resonances(recording, small_signal(recording))
    except RigProblemError as error:
        if error.code != "noise":
            raise
        return measured, "below the noise"
    text = "".join(f"resonance {at.natural_hz:.4g} Hz at {at.place_um:.3g} µm" for at in found)
    after = replace(measured, resonances=(*measured.resonances, *found))
    return after, text or "no clear resonance"


def _growing(part: float, limits: Limits, measured: Measured) -> Keys | None:
    amplitude = next_amplitude(measured.growing, part * limits.reach, limits.stroke_um)
    return None if amplitude is None else _middle_loop(limits, amplitude)


def _middle_loop(limits: Limits, amplitude: float) -> Keys:
    return waveforms.sine(limits, amplitude, limits.middle_hz, max(4.0, 0.4 * limits.middle_hz))


def _take_growing(recording: Recording, limits: Limits, measured: Measured) -> Evaluated:
    found = loop_metrics(recording, recording.segments[-1])
    loop = f"{found.amplitude:.3g} {limits.unit} moves {found.peak_to_peak_um:.3g} µm"
    if found.scatter_percent > _MOST_SCATTER_PERCENT:
        _refuse_unrepeatable(f"cycles of {loop} differ by {found.scatter_percent:.2g} % rms")
    low_um, high_um = limits.stroke_um
    span = f"{found.low_um:.3g} to {found.high_um:.3g} µm of {low_um:g} to {high_um:g}"
    return replace(measured, growing=(*measured.growing, found)), f"{loop}: {span}"


def _refuse_unrepeatable(text: str) -> NoReturn:
    raise RigProblemError(
        "not_repeatable",
        f"not repeatable: {text} of their peak-to-peak",
        "check for play in the mounting, a loose preload, a slipping sensor, or warming; then "
        "repeat the characterisation with --overwrite",
    )


def _fast(limits: Limits, measured: Measured) -> Keys:
    full, small = full_amplitude(limits, measured), measured.small
    amplitudes = {
        frequency_hz: full / max(1.0, small.size_at(frequency_hz) if small else 1.0)
        for frequency_hz in waveforms.frequencies_hz(limits)
    }
    return waveforms.fast_loops(limits, amplitudes)


def _settled(limits: Limits, measured: Measured) -> Keys:
    full, loops = full_amplitude(limits, measured), measured.growing
    straight = np.array([limits.centre - full, limits.centre + full])
    return waveforms.settled_loops(limits, full, centre_line(loops[-1]) if loops else straight)


def _take_slow(recording: Recording, limits: Limits, measured: Measured) -> Evaluated:
    loops = all_loops(recording)
    largest = max(loops, key=lambda each: each.amplitude)
    if measured.rest and largest.peak_to_peak_um < _LEAST_MOTION * measured.rest.noise_um:
        raise RigProblemError(
            "noise",
            f"noise is larger than the motion: {measured.rest.noise_um:.3g} µm rms at rest, "
            f"{largest.peak_to_peak_um:.3g} µm peak-to-peak at the largest amplitude",
            "widen the limits as far as the actuator allows, or use a better sensor",
        )
    return replace(measured, slow=loops), f"hysteresis {largest.hysteresis_percent or 0.0:.3g} %"


def _take_fast(recording: Recording, limits: Limits, measured: Measured) -> Evaluated:
    loops = all_loops(recording)
    fastest = max(loops, key=lambda each: (each.frequency_hz, each.amplitude))
    percent = fastest.hysteresis_percent or 0.0
    return replace(
        measured, fast=loops
    ), f"hysteresis {percent:.3g} % at {fastest.frequency_hz:g} Hz"


def _take_reversal(recording: Recording, limits: Limits, measured: Measured) -> Evaluated:
    found = reversal_curves(recording)
    text = f"{len(found.turns)} curves"
    if not math.isnan(found.return_percent):
        text += f" return to {found.return_percent:.2g} % of their span"
    return replace(measured, reversal=found), text


def _take_biased(recording: Recording, limits: Limits, measured: Measured) -> Evaluated:
    found = all_loops(recording)
    gains = [each.gain_um for each in found]
    text = f"gain {min(gains):.3g} to {max(gains):.3g} µm/{limits.unit} over the range"
    return replace(measured, biased=found), text


def _take_creep(recording: Recording, limits: Limits, measured: Measured) -> Evaluated:
    found = crept_percent(recording)
    crept = " and ".join(f"{percent:+.2g}" for percent in found)
    return replace(measured, crept_percent=found), f"creep {crept} % in {waveforms.CREEP_S:g} s"


def _take_again(recording: Recording, limits: Limits, measured: Measured) -> Evaluated:
    again = loop_metrics(recording, recording.segments[-1])
    found = repeatability(measured.growing[-1], again)
    shape, shift = f"{found.shape_percent:.2g} % in shape", f"{found.shift_percent:.2g} % in offset"
    if math.hypot(found.shape_percent, found.shift_percent) > _MOST_SCATTER_PERCENT:
        _refuse_unrepeatable(f"the largest loop has changed by {shape} and {shift}")
    return replace(
        measured, repeated=found
    ), f"differs by {shape}, {shift} ({found.shift_um:+.3g} µm)"


_Row: TypeAlias = tuple[str, str, Waveform, Evaluate]


def _numbered(
    name: str,
    purpose: str,
    parts: tuple[float, ...],
    waveform: Callable[[float, Limits, Measured], Keys | None],
    take: Evaluate,
) -> list[_Row]:
    return [
        (f"{name}-{i}", f"{purpose}, {100.0 * part:g} %", partial(waveform, part), take)
        for i, part in enumerate(parts, 1)
    ]


_ROWS: list[_Row] = [
    ("rest", "noise and drift at rest", lambda limits, _: waveforms.at_rest(limits), _take_rest),
    *_numbered("polarity", "first reaction, its sign", POLARITY_PARTS, _polarity, _take_polarity),
    *_numbered("response", "small-signal response", SMALL_PARTS, _response, _take_response),
    *_numbered("growing", "loop of growing amplitude", GROWING_PARTS, _growing, _take_growing),
    ("slow-loops", "loops at the lowest frequency", _at_full(waveforms.slow_loops), _take_slow),
    ("fast-loops", "loops at several frequencies", _fast, _take_fast),
    ("reversal-curves", "first-order reversal curves", _at_full(waveforms.reversal_curves),
     _take_reversal),
    ("biased-loops", "loops over the whole range, each from rest", _at_full(waveforms.biased_loops),
     _take_biased),
    ("creep", "creep at both ends of the range", _at_full(waveforms.rests), _take_creep),
    ("small-motions", "small random motions", _at_full(waveforms.small_motions),
     _unevaluated("for the fit")),
    ("settled-loops", "small loops up to both ends", _settled, _unevaluated("for the fit")),
    ("training", "random reference for the fit", _random(waveforms.TRAINING_SEED),
     _unevaluated("for the fit")),
    ("held-out", "random reference for the validation", _random(waveforms.HELD_OUT_SEED),
     _unevaluated("not used in any fit")),
    *_numbered("placed-response", "small-signal response off rest", RESPONSE_PLACES,
               _placed_response, _take_placed_response),
    ("repeated", "the largest loop again", _at_full(_middle_loop), _take_again),
]  # fmt: skip
STEPS = tuple(CharacterisationStep(*row) for row in _ROWS)
