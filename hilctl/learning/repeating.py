"""Which waveforms of an experiment can be learned, and from where."""

import numpy as np

from hilctl.base.arrays import C128
from hilctl.base.errors import ConfigError, Problem
from hilctl.base.segments import Segment
from hilctl.experiment.check import Checked
from hilctl.experiment.correction import LearnedCycle, fits, signature
from hilctl.learning.cycle import harmonic_count
from hilctl.learning.update import Learning, begin

HIGHEST_PART = 0.125
"""Highest frequency that a correction reaches, as a part of the sample rate."""

_FEWEST_CYCLES = 2


def repeating(checked: Checked) -> list[Segment]:
    """Return the segments to learn, the first of those that are alike.

    Raises:
        ConfigError: There is none, or one is too short; or no compensator stands there.
    """
    loaded = checked.loaded

    def refuse(key: str, rule: str, hint: str) -> ConfigError:
        return ConfigError([Problem(loaded.document.where((key,)), key, rule, hint=hint)])

    if loaded.model is None:
        raise refuse("compensator", "is needed to learn: its input is corrected", "set a model")
    found: list[Segment] = []
    known: list[LearnedCycle] = []
    for segment in checked.reference.segments:
        wanted = signature(checked.reference.values, segment)
        if wanted is None or segment.steady_cycles()[2] < _FEWEST_CYCLES:
            continue
        if any(fits(cycle, checked.reference.values, segment) for cycle in known):
            continue
        found.append(segment)
        nothing = np.zeros(1, dtype=np.complex128)
        known.append(LearnedCycle.from_coefficients(segment.label, segment.period, wanted, nothing))
    if not found:
        rule = f"must repeat for at least {_FEWEST_CYCLES} whole cycles after its soft start"
        raise refuse("waveform", rule, "16 or more average the noise well")
    return found


def beginning(checked: Checked, segment: Segment) -> Learning:
    """Return where learning begins: with nothing, or with the correction the experiment has."""
    rate_hz = checked.reference.sample_rate_hz
    highest_hz = HIGHEST_PART * rate_hz
    count = harmonic_count(segment.period, rate_hz / segment.period, highest_hz)
    first: C128 = np.zeros(count + 1, dtype=np.complex128)
    known = checked.loaded.correction
    for cycle in known.cycles if known else ():
        if fits(cycle, checked.reference.values, segment):
            size = min(first.size, cycle.coefficients.size)
            first[:size] = cycle.coefficients[:size]
    return begin(rate_hz, first, highest_hz)
