"""The steps of a campaign, in order: each is one run, and knows what those before it measured."""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from hilctl.recording.recording import Recording
from hilctl.studies.characterise import waveforms
from hilctl.studies.characterise.limits import CharacterisationLimits
from hilctl.studies.characterise.loops import (
    all_loops,
    loop_figures,
    next_amplitude,
    repeatability,
    reversal_curves,
)
from hilctl.studies.characterise.response import (
    RigProblemError,
    crept_percent,
    rest_noise,
    sine_reaction,
    small_signal,
)
from hilctl.studies.characterise.results import Measured
from hilctl.studies.characterise.waveforms import Keys

POLARITY_PARTS = (0.01, 0.03, 0.1)
SMALL_PARTS = (0.05, 0.25)
GROWING_PARTS = (0.1, 0.25, 0.5, 0.75, 1.0)

_MOST_RANDOM = 0.95
_CYCLES = 12.0
_LOUD = 0.05  # rms noise over the whole stroke at which nothing can be told from it
_LEAST_MOTION = 6.0  # peak-to-peak displacement of the largest loop, over the rms noise
_CLEAR_OF_BAND = 1.5
_SAFE_OF_RESONANCE = 3.0
_MOST_SCATTER_PERCENT = 5.0


@dataclass(frozen=True, slots=True)
class CharacterisationStep:
    """One step: one run.

    Attributes:
        name: Its name, and that of its recording.
        purpose: What it is for.
        waveform: Gives the waveform's keys; None where the step is not needed.
        take: Judges its recording; gives what is known then, and a line for people.
    """

    name: str
    purpose: str
    waveform: Callable[[CharacterisationLimits, Measured], Keys | None]
    take: Callable[[Recording, CharacterisationLimits, Measured], tuple[Measured, str]]


def full_amplitude(limits: CharacterisationLimits, measured: Measured) -> float:
    """Return the largest amplitude that has been tried, or is about to be."""
    return measured.growing[-1].amplitude if measured.growing else limits.reach


def _rest(limits: CharacterisationLimits, measured: Measured) -> Keys:
    del measured
    return waveforms.at_rest(limits)


def _take_rest(
    recording: Recording, limits: CharacterisationLimits, measured: Measured
) -> tuple[Measured, str]:
    del limits
    found = rest_noise(recording)
    text = f"noise {found.noise_um:.3g} µm rms, drift {found.drift_um_per_s:+.2g} µm/s"
    return measured.also(rest=found), text


def _polarity(part: float) -> Callable[[CharacterisationLimits, Measured], Keys | None]:
    def make(limits: CharacterisationLimits, measured: Measured) -> Keys | None:
        if measured.reaction is not None and measured.reaction.clear:
            return None
        amplitude = part * limits.reach
        offset = limits.beside_rest(amplitude)
        return waveforms.sine(limits, amplitude, limits.middle_hz, _CYCLES, offset=offset)

    return make


def _take_polarity(
    recording: Recording, limits: CharacterisationLimits, measured: Measured
) -> tuple[Measured, str]:
    found = sine_reaction(recording)
    after = measured.also(reaction=found)
    percent = 100.0 * found.amplitude / limits.reach
    last = found.amplitude > 0.9 * POLARITY_PARTS[-1] * limits.reach
    if found.clear and not found.even:
        _refuse_negative(found.gain_um, percent, limits.unit)
        return after, f"{found.gain_um:.3g} µm/{limits.unit} at {percent:.2g} % of the range"
    if last and found.even:
        raise RigProblemError(
            "no_bias",
            f"the displacement reacts alike to both signs of the command ({found.second_um:.3g} µm "
            f"at twice its frequency, {found.motion_um:.3g} µm at it)",
            "give the rods their bias, magnet or current, or record loops and use 'hilctl identify "
            "--model butterfly'",
        )
    if last:
        _refuse_silent(measured, limits, found.amplitude, percent)
    return after, f"nothing clear at {percent:.2g} % of the range"


def _refuse_negative(gain_um: float, percent: float, unit: str) -> None:
    if gain_um < 0.0:
        raise RigProblemError(
            "wrong_polarity",
            f"the displacement falls as the command rises, {gain_um:.3g} µm/{unit} at "
            f"{percent:.2g} % of the range",
            "swap the wires of coil or sensor, or turn the sign of the sensor's scale in the "
            "device's profile",
        )


def _refuse_silent(
    measured: Measured, limits: CharacterisationLimits, amplitude: float, percent: float
) -> None:
    noise_um = measured.rest.noise_um if measured.rest else 0.0
    moved = f"a sine of {amplitude:.3g} {limits.unit}, {percent:.2g} % of the range,"
    if noise_um > _LOUD * limits.stroke_span_um:
        share = 100.0 * noise_um / limits.stroke_span_um
        raise RigProblemError(
            "noise",
            f"noise is larger than the motion: {noise_um:.3g} µm rms at rest, {share:.0f} % of the "
            f"allowed stroke, hides what {moved} does",
            "look at the sensor's ground, shield and range",
        )
    raise RigProblemError(
        "no_reaction",
        f"no reaction: {moved} moves nothing that shows above {noise_um:.3g} µm rms of noise",
        "look whether the amplifier is on and enabled, at the coil's wires, and whether the sensor "
        "sees the actuator",
    )


def _response(part: float) -> Callable[[CharacterisationLimits, Measured], Keys | None]:
    def make(limits: CharacterisationLimits, measured: Measured) -> Keys | None:
        if measured.small is not None:
            return None
        return waveforms.small_multisine(limits, part * limits.reach)

    return make


def _take_response(
    recording: Recording, limits: CharacterisationLimits, measured: Measured
) -> tuple[Measured, str]:
    try:
        found = small_signal(recording)
    except RigProblemError as error:
        tried = 0.5 * float(np.ptp(recording.samples.command))
        if error.code != "noise" or tried > 0.9 * SMALL_PARTS[-1] * limits.reach:
            raise
        return measured, f"lost in noise at {100.0 * tried / limits.reach:.2g} % of the range"
    natural_hz = found.natural_hz
    delay = f"delay {1e3 * found.delay_s:.3g} ms, lag {1e3 * found.lag_s:.3g} ms"
    text = f"gain {found.gain_um:.3g} µm/{limits.unit}, {delay}"
    if natural_hz is None:
        return measured.also(small=found), f"{text}, no resonance"
    if natural_hz < _CLEAR_OF_BAND * limits.highest_hz:
        band = f"{limits.lowest_hz:g} to {limits.highest_hz:g} Hz"
        lower_hz = natural_hz / _SAFE_OF_RESONANCE
        raise RigProblemError(
            "resonance",
            f"a resonance at {natural_hz:.4g} Hz (damping {found.damping_ratio:.2g}) lies inside "
            f"or just above the band of the loops, {band}",
            f"give --highest-hz {lower_hz:.2g} or less, or stiffen the load",
        )
    text += f", resonance {natural_hz:.4g} Hz, damping {found.damping_ratio:.2g}"
    return measured.also(small=found), text


def _growing(part: float) -> Callable[[CharacterisationLimits, Measured], Keys | None]:
    def make(limits: CharacterisationLimits, measured: Measured) -> Keys | None:
        amplitude = next_amplitude(measured.growing, part * limits.reach, limits.stroke_um)
        return None if amplitude is None else _middle_loop(limits, amplitude)

    return make


def _middle_loop(limits: CharacterisationLimits, amplitude: float) -> Keys:
    return waveforms.sine(limits, amplitude, limits.middle_hz, max(4.0, 0.4 * limits.middle_hz))


def _take_growing(
    recording: Recording, limits: CharacterisationLimits, measured: Measured
) -> tuple[Measured, str]:
    found = loop_figures(recording, recording.segments[-1])
    loop = f"{found.amplitude:.3g} {limits.unit} moves {found.peak_to_peak_um:.3g} µm"
    if found.scatter_percent > _MOST_SCATTER_PERCENT:
        _refuse_unrepeatable(f"cycles of {loop} differ by {found.scatter_percent:.2g} % rms")
    low_um, high_um = limits.stroke_um
    span = f"{found.low_um:.3g} to {found.high_um:.3g} µm of {low_um:g} to {high_um:g}"
    return measured.also(growing=(*measured.growing, found)), f"{loop}: {span}"


def _refuse_unrepeatable(text: str) -> None:
    raise RigProblemError(
        "not_repeatable",
        f"not repeatable: {text} of their peak-to-peak",
        "look for play in the mounting, a loose preload, a sensor that slips, or warming; then "
        "run it all again",
    )


def _slow(limits: CharacterisationLimits, measured: Measured) -> Keys:
    return waveforms.slow_loops(limits, full_amplitude(limits, measured))


def _fast(limits: CharacterisationLimits, measured: Measured) -> Keys:
    full = full_amplitude(limits, measured)
    small = measured.small
    amplitudes = {
        frequency_hz: full / max(1.0, small.size_at(frequency_hz) if small else 1.0)
        for frequency_hz in waveforms.frequencies_hz(limits)
    }
    return waveforms.fast_loops(limits, amplitudes)


def _take_slow(
    recording: Recording, limits: CharacterisationLimits, measured: Measured
) -> tuple[Measured, str]:
    del limits
    largest = max(all_loops(recording), key=lambda each: each.amplitude)
    if measured.rest and largest.peak_to_peak_um < _LEAST_MOTION * measured.rest.noise_um:
        raise RigProblemError(
            "noise",
            f"noise is larger than the motion: {measured.rest.noise_um:.3g} µm rms at rest, "
            f"{largest.peak_to_peak_um:.3g} µm peak-to-peak at the largest amplitude",
            "widen the limits as far as the actuator allows, or take a better sensor",
        )
    after = measured.also(slow=all_loops(recording))
    return after, f"hysteresis {largest.hysteresis_percent or 0.0:.3g} %"


def _take_fast(
    recording: Recording, limits: CharacterisationLimits, measured: Measured
) -> tuple[Measured, str]:
    del limits
    loops = all_loops(recording)
    fastest = max(loops, key=lambda each: (each.frequency_hz, each.amplitude))
    percent = fastest.hysteresis_percent or 0.0
    text = f"hysteresis {percent:.3g} % at {fastest.frequency_hz:g} Hz"
    return measured.also(fast=loops), text


def _reversal(limits: CharacterisationLimits, measured: Measured) -> Keys:
    return waveforms.reversal_curves(limits, full_amplitude(limits, measured))


def _take_reversal(
    recording: Recording, limits: CharacterisationLimits, measured: Measured
) -> tuple[Measured, str]:
    del limits
    found = reversal_curves(recording)
    text = f"{len(found.turns)} curves return to {found.return_percent:.2g} % of their span"
    return measured.also(reversal=found), text


def _biased(limits: CharacterisationLimits, measured: Measured) -> Keys:
    return waveforms.biased_loops(limits, full_amplitude(limits, measured))


def _take_biased(
    recording: Recording, limits: CharacterisationLimits, measured: Measured
) -> tuple[Measured, str]:
    found = all_loops(recording)
    gains = [each.gain_um for each in found]
    text = f"gain {min(gains):.3g} to {max(gains):.3g} µm/{limits.unit} over the range"
    return measured.also(biased=found), text


def _rests(limits: CharacterisationLimits, measured: Measured) -> Keys:
    return waveforms.rests(limits, full_amplitude(limits, measured))


def _take_rests(
    recording: Recording, limits: CharacterisationLimits, measured: Measured
) -> tuple[Measured, str]:
    del limits
    found = crept_percent(recording)
    crept = " and ".join(f"{percent:+.2g}" for percent in found)
    text = f"moves on by {crept} % in {waveforms.CREEP_S:g} s"
    return measured.also(crept_percent=found), text


def _small(limits: CharacterisationLimits, measured: Measured) -> Keys:
    return waveforms.small_motions(limits, full_amplitude(limits, measured))


def _random(seed: int) -> Callable[[CharacterisationLimits, Measured], Keys]:
    def make(limits: CharacterisationLimits, measured: Measured) -> Keys:
        amplitude = _MOST_RANDOM * full_amplitude(limits, measured)
        return waveforms.random_reference(limits, amplitude, seed)

    return make


def _taken(
    text: str,
) -> Callable[[Recording, CharacterisationLimits, Measured], tuple[Measured, str]]:
    """Return what takes a recording that nothing is measured from before the model."""

    def take(
        recording: Recording, limits: CharacterisationLimits, measured: Measured
    ) -> tuple[Measured, str]:
        del recording, limits
        return measured, text

    return take


def _again(limits: CharacterisationLimits, measured: Measured) -> Keys:
    return _middle_loop(limits, full_amplitude(limits, measured))


def _take_again(
    recording: Recording, limits: CharacterisationLimits, measured: Measured
) -> tuple[Measured, str]:
    del limits
    again = loop_figures(recording, recording.segments[-1])
    found = repeatability(measured.growing[-1], again)
    shape, shift = f"{found.shape_percent:.2g} % in shape", f"{found.shift_percent:.2g} % in place"
    if math.hypot(found.shape_percent, found.shift_percent) > _MOST_SCATTER_PERCENT:
        _refuse_unrepeatable(f"the largest loop has changed by {shape} and {shift}")
    return measured.also(repeated=found), f"differs by {shape}, {shift} ({found.shift_um:+.3g} µm)"


def _numbered(
    name: str,
    purpose: str,
    parts: tuple[float, ...],
    waveform: Callable[[float], Callable[[CharacterisationLimits, Measured], Keys | None]],
    take: Callable[[Recording, CharacterisationLimits, Measured], tuple[Measured, str]],
) -> list[CharacterisationStep]:
    return [
        CharacterisationStep(f"{name}-{i}", f"{purpose}, {100.0 * part:g} %", waveform(part), take)
        for i, part in enumerate(parts, 1)
    ]


STEPS: tuple[CharacterisationStep, ...] = (
    CharacterisationStep("rest", "noise and drift at rest", _rest, _take_rest),
    *_numbered("polarity", "first reaction, its sign", POLARITY_PARTS, _polarity, _take_polarity),
    *_numbered("response", "small-signal response", SMALL_PARTS, _response, _take_response),
    *_numbered("growing", "loop of growing amplitude", GROWING_PARTS, _growing, _take_growing),
    CharacterisationStep("slow-loops", "loops at the lowest frequency", _slow, _take_slow),
    CharacterisationStep("fast-loops", "loops at several frequencies", _fast, _take_fast),
    CharacterisationStep(
        "reversal-curves", "first-order reversal curves", _reversal, _take_reversal
    ),
    CharacterisationStep("biased-loops", "small loops all over the range", _biased, _take_biased),
    CharacterisationStep("creep", "creep in rests on either side", _rests, _take_rests),
    CharacterisationStep("small-motions", "small random motions", _small, _taken("for the fit")),
    CharacterisationStep(
        "training",
        "a random reference, for the fit",
        _random(waveforms.TRAINING_SEED),
        _taken("for the fit"),
    ),
    CharacterisationStep(
        "held-out",
        "a random reference, for the judgement",
        _random(waveforms.HELD_OUT_SEED),
        _taken("kept from every fit"),
    ),
    CharacterisationStep("repeated", "the largest loop once more", _again, _take_again),
)
