"""Feedback from an experiment: its design, what it can't be without, and the controller.

With the compensator before it, the actuator is a gain of about 1 and a delay, so what limits the
bandwidth is the delay, and with it the rate.
"""

import cmath
import math

import numpy as np

from hilctl.base.errors import ConfigProblem
from hilctl.experiment.file import Experiment
from hilctl.experiment.load import LoadedExperiment
from hilctl.experiment.sections import IntegralFeedbackConfig, PiFeedbackConfig
from hilctl.loop.compensator import Compensator
from hilctl.loop.feedback import Controller, Feedback, Gains, IntegralFeedback

LOOP_DELAY = 2
"""Samples from a correction to the first tick that sees its effect: one until the sensor can show
it, and one until the displacement that came with that exchange is used."""

LEAST_GAIN_MARGIN = 2.0
LEAST_PHASE_MARGIN_DEG = 60.0
SLOW_SHARE = 0.2
"""Bandwidth of an integrator of block means, as a share of 1 / (2 pi delay): it leaves a phase
margin of 79 degrees and a gain margin of nearly 8, also to an actuator of several times the gain
that the model says, as on small loops."""
UNKNOWN_RESONANCE_HZ = 5.0
"""Highest bandwidth of such an integrator where no resonance is known: it leaves a gain margin of 2
to any above 500 Hz with a damping of 1 %."""
_FREQUENCIES = 4096
_HIGHEST_RATE_HZ = 1e6


def make_feedback(
    config: Experiment, compensator: Compensator, latency_blocks: int = 0
) -> Controller | None:
    """Return the feedback of a run, or None where there is none.

    Args:
        config: The experiment.
        compensator: What it corrects the input of.
        latency_blocks: Exchanges from a block's commands to its displacements.
    """
    wanted = config.feedback
    if wanted is None:
        return None
    rate_hz = config.sample_rate_hz
    due_after, shown_after = delays(wanted.sensor_delay_s, rate_hz, compensator.preview)
    if isinstance(wanted, IntegralFeedbackConfig):
        gain = 2.0 * math.pi * wanted.bandwidth_hz * config.tick_s
        blocks = latency_blocks + LOOP_DELAY + math.ceil(shown_after / config.block)
        return IntegralFeedback(gain, wanted.limit_um, due_after, blocks)
    gains = _gains(wanted, rate_hz)
    return Feedback(gains, rate_hz, wanted.limit_um, due_after, shown_after + LOOP_DELAY)


def delays(sensor_delay_s: float, rate_hz: float, preview: int) -> tuple[int, int]:
    """Return the samples from a reference, and from the input, to the displacement that shows it.

    Args:
        sensor_delay_s: What the sensor and its line add.
        rate_hz: Samples a second.
        preview: Samples by which the compensator's input runs ahead of its commands.
    """
    due_after = round(sensor_delay_s * rate_hz) + (0 if preview else 1)
    return due_after, due_after + preview


def feedback_problems(loaded: LoadedExperiment, preview: int) -> list[ConfigProblem]:
    """Return why an experiment can't have the feedback that it asks for.

    Args:
        loaded: The experiment.
        preview: Samples by which its compensator looks ahead: so long a correction takes to show.
    """
    config, wanted = loaded.config, loaded.config.feedback
    if wanted is None:
        return []
    found: list[tuple[str, str, str, str]] = []
    if config.compensator is None:
        found.append(("feedback", "needs a compensator: it corrects what goes into one", "", ""))
    if isinstance(wanted, IntegralFeedbackConfig):
        found += _slow_problems(loaded, wanted, preview)
    else:
        found += _fast_problems(loaded, wanted, preview)
    return [
        ConfigProblem(loaded.document.where(tuple(key.split("."))), key, rule, value, hint)
        for key, rule, value, hint in found
    ]


def _fast_problems(
    loaded: LoadedExperiment, wanted: PiFeedbackConfig, preview: int
) -> list[tuple[str, str, str, str]]:
    config, info = loaded.config, loaded.device.info
    found = []
    slow = "feedback.kind integral takes out what is slow on every device"
    if info.latency_blocks:
        rule = f"needs a device that answers each sample at once: {info.name} plays from a FIFO"
        found.append(("feedback", rule, "", slow))
    if config.block > 1:
        hint = f"a block's first displacement would be as old as the block; {slow}"
        found.append(("block", "must be 1 with feedback", str(config.block), hint))
    if found or config.compensator is None:
        return found
    delay_s = wanted.sensor_delay_s + max(0, preview - 1) / config.sample_rate_hz
    found += _gain_problems(wanted, config.sample_rate_hz, delay_s)
    return found + _resonance_problems(loaded, wanted)


def _slow_problems(
    loaded: LoadedExperiment, wanted: IntegralFeedbackConfig, preview: int
) -> list[tuple[str, str, str, str]]:
    """Hold the bandwidth of an integrator against the loop's delay and the resonance."""
    config, info = loaded.config, loaded.device.info
    shown_s = wanted.sensor_delay_s + max(1, preview) / config.sample_rate_hz
    delay_s = (info.latency_blocks + 1) * config.tick_s + shown_s
    highest_hz = SLOW_SHARE / (2.0 * math.pi * delay_s)
    rule = (
        f"must be <= {highest_hz:.4g} Hz, {SLOW_SHARE:g} / (2 pi {delay_s:.3g} s), the delay of "
        "the loop"
    )
    natural_hz, damping = _resonance(loaded, wanted)
    hint = "a smaller block or a higher rate makes the delay shorter"
    if natural_hz is not None and damping is not None:
        if damping * natural_hz < highest_hz:
            highest_hz = damping * natural_hz
            rule = f"must be <= {highest_hz:.4g} Hz, damping times frequency of the resonance"
            hint = f"the gain at {natural_hz:g} Hz must be at most {1.0 / LEAST_GAIN_MARGIN:g}"
    elif highest_hz > UNKNOWN_RESONANCE_HZ:
        highest_hz = UNKNOWN_RESONANCE_HZ
        rule = f"must be <= {highest_hz:g} Hz where no resonance is known"
        hint = "give resonance_hz and damping_ratio of the actuator with its load"
    if wanted.bandwidth_hz <= highest_hz:
        return []
    return [("feedback.bandwidth_hz", rule, f"{wanted.bandwidth_hz:g}", hint)]


def _gains(wanted: PiFeedbackConfig, rate_hz: float) -> Gains:
    if wanted.bandwidth_hz is not None:
        return gains_for(min(wanted.bandwidth_hz, 0.5 * rate_hz), rate_hz)
    return Gains(wanted.kp or 0.0, wanted.ki_per_s or 0.0)


def _gain_problems(
    wanted: PiFeedbackConfig, rate_hz: float, delay_s: float
) -> list[tuple[str, str, str, str]]:
    """Hold the gains against the delay: phase margin of 60 degrees, gain margin of 2."""
    if wanted.bandwidth_hz is not None:
        highest_hz = highest_bandwidth_hz(rate_hz, delay_s)
        if wanted.bandwidth_hz <= highest_hz:
            return []
        rule = f"must be <= {highest_hz:.4g} Hz at {rate_hz:g} Hz and a delay of {delay_s:.3g} s"
        needed_hz = rate_needed_hz(wanted.bandwidth_hz, delay_s)
        return [("feedback.bandwidth_hz", rule, f"{wanted.bandwidth_hz:g}", _needs(needed_hz))]
    gains = _gains(wanted, rate_hz)
    if _stable(gains, rate_hz, delay_s):
        return []
    gain_margin, phase_margin = margins(gains, rate_hz, delay_s)
    rule = (
        f"must leave a gain margin of {LEAST_GAIN_MARGIN:g} and a phase margin of "
        f"{LEAST_PHASE_MARGIN_DEG:g} degrees at {rate_hz:g} Hz and a delay of {delay_s:.3g} s"
    )
    value = f"kp {gains.kp:g}, ki_per_s {gains.ki_per_s:g}: {gain_margin:.3g}, {phase_margin:.3g}"
    return [("feedback", rule, value, _needs(_rate_for(gains, rate_hz, delay_s)))]


def _stable(gains: Gains, rate_hz: float, delay_s: float) -> bool:
    gain_margin, phase_margin = margins(gains, rate_hz, delay_s)
    return gain_margin >= LEAST_GAIN_MARGIN and phase_margin >= LEAST_PHASE_MARGIN_DEG


def _rate_for(gains: Gains, rate_hz: float, delay_s: float) -> float:
    """Return a rate, to 5 %, at which the gains have their margins; infinite without one."""
    while rate_hz < _HIGHEST_RATE_HZ:
        rate_hz *= 1.05
        if _stable(gains, rate_hz, delay_s):
            return rate_hz
    return math.inf


def _needs(rate_hz: float) -> str:
    if rate_hz <= _HIGHEST_RATE_HZ:
        return f"this needs at least {rate_hz:.4g} samples a second"
    return "no sample rate is enough for this"


def _resonance_problems(
    loaded: LoadedExperiment, wanted: PiFeedbackConfig
) -> list[tuple[str, str, str, str]]:
    """Hold the gain at the resonance, where a light one multiplies it by 1/(2 damping), to half."""
    natural_hz, damping = _resonance(loaded, wanted)
    if natural_hz is None or damping is None:
        rule = "needs resonance_hz and damping_ratio of the actuator with its load"
        return [("feedback", rule, "", "the model does not tell them, and feedback excites it")]
    rate_hz = loaded.config.sample_rate_hz
    gains = _gains(wanted, rate_hz)
    turn = 1.0 - cmath.exp(-2j * math.pi * min(natural_hz / rate_hz, 0.5))
    size = abs(gains.kp + gains.ki_per_s / rate_hz / turn) / (2.0 * damping)
    if size * LEAST_GAIN_MARGIN <= 1.0:
        return []
    rule = f"must have a gain of at most {1.0 / LEAST_GAIN_MARGIN:g} at the resonance"
    where = f"{natural_hz:g} Hz, damping {damping:g}"
    hint = f"at most bandwidth_hz {damping * natural_hz:.3g}, or ki_per_s of 2 pi times that"
    return [("feedback", rule, f"{size:.3g} at {where}", hint)]


def _resonance(
    loaded: LoadedExperiment, wanted: PiFeedbackConfig | IntegralFeedbackConfig
) -> tuple[float | None, float | None]:
    """Return natural frequency in Hz and damping: the experiment's, else those of the model."""
    structure = getattr(loaded.model, "structure", None)
    natural_hz = wanted.resonance_hz or getattr(structure, "natural_hz", None)
    return natural_hz, wanted.damping_ratio or getattr(structure, "damping_ratio", None)


def gains_for(bandwidth_hz: float, rate_hz: float) -> Gains:
    """Return the gains whose open loop crosses 1 at ``bandwidth_hz``, below half the rate.

    An actuator that is a gain of 1 and a delay needs no proportional part: the integral alone
    crosses 1 at ``ki / (2 pi)``, and falls from there on.
    """
    return Gains(0.0, 2.0 * rate_hz * math.sin(math.pi * bandwidth_hz / rate_hz))


def highest_bandwidth_hz(rate_hz: float, extra_delay_s: float = 0.0) -> float:
    """Return the largest bandwidth that leaves the least phase margin.

    The integral is 90 degrees late less half a sample, the loop two samples: together 1.5 samples.
    The margin of 60 degrees leaves 30 degrees for these and the extra delay.

    Args:
        rate_hz: Samples a second.
        extra_delay_s: What link and sensor add.
    """
    share = (90.0 - LEAST_PHASE_MARGIN_DEG) / 360.0
    return share / ((LOOP_DELAY - 0.5) / rate_hz + extra_delay_s)


def rate_needed_hz(bandwidth_hz: float, extra_delay_s: float = 0.0) -> float:
    """Return the sample rate that a bandwidth needs; infinite where the extra delay forbids it."""
    share = (90.0 - LEAST_PHASE_MARGIN_DEG) / 360.0
    left_s = share / bandwidth_hz - extra_delay_s
    return (LOOP_DELAY - 0.5) / left_s if left_s > 0.0 else math.inf


def margins(gains: Gains, rate_hz: float, extra_delay_s: float = 0.0) -> tuple[float, float]:
    """Return gain margin and phase margin, in degrees, on an actuator of gain 1.

    The gain margin is 1 over the largest open-loop gain wherever the loop is later than 180
    degrees; 0 degrees of phase margin stand for a loop gain that never falls below 1.
    """
    angle = np.geomspace(1e-6, math.pi, _FREQUENCIES)
    controller = gains.kp + gains.ki_per_s / rate_hz / (1.0 - np.exp(-1j * angle))
    size = np.abs(controller)
    late = angle * (LOOP_DELAY + extra_delay_s * rate_hz) - np.angle(controller)
    beyond = size[late >= math.pi]
    gain_margin = float(1.0 / beyond.max()) if beyond.size else math.inf
    above = np.flatnonzero(size >= 1.0)
    if not above.size:
        return gain_margin, 180.0
    if above[-1] == angle.size - 1:
        return gain_margin, 0.0
    return gain_margin, math.degrees(math.pi - float(late[: above[-1] + 1].max()))
