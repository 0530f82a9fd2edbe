"""Play, stop and deadband operators, their weighted sums, and the integrated model.

Notation: ``v`` is an input, ``x`` the signal between plays and deadbands, ``y`` an output. The
*widening* is the rate-dependent part of every threshold: ``r_i(v') = r_i + gamma |v'|`` (6.18).

Memory of a sum of m plays, float64[m + 1]: the m operator outputs, then the previous input. NaN
means that there is none yet; then the rate is zero, and an operator with output 0 starts at
``max(v_0 - r, min(v_0 + r, 0))`` as in the literature. Memory is updated in place, so any division
into blocks gives the same bits. ``out`` may be the input array itself.

Source: "Modeling and Compensation of Rate-Dependent Asymmetric Hysteresis Nonlinearities of
Magnetostrictive Actuators", Concordia; equation numbers are that dissertation's.
"""

import math
from typing import TypeAlias

import numpy as np

from hilctl.base.types import F64, F64_2D
from hilctl.kernels.jit import kernel

Plays: TypeAlias = tuple[float, float, F64, F64]
"""Widening for a change of 1 between samples (gamma times the sample rate; 0 for the
rate-independent model), weight of the input itself (a_0), thresholds (rising, in the unit of the
input) and weights, float64[m] each."""
Deadbands: TypeAlias = tuple[float, F64, F64, F64, F64]
"""g_0; thresholds (rising, > 0) and weights on the side above 0; thresholds (falling, < 0) and
weights on the side below. Thresholds are in the unit of the input."""


@kernel()
def stop_step(v: float, v_previous: float, threshold: float, held: float) -> float:
    """Advance one stop operator by one sample (section 3.3); its output stays within the threshold.

    ``threshold`` is > 0, in the unit of ``v``; ``held`` is the operator's previous output.
    """
    return min(threshold, max(-threshold, v - v_previous + held))


@kernel(inline=True)
def _widening(change: float, gain: float) -> float:
    rate = abs(change)
    return gain * rate if rate >= 0.0 else 0.0  # NaN: there is no previous input


@kernel(inline=True)
def _move_plays(v: float, widening: float, thresholds: F64, memory: F64) -> None:
    for i in range(thresholds.size):
        threshold = thresholds[i] + widening
        memory[i] = max(min(memory[i], v + threshold), v - threshold)


@kernel(inline=True)
def _weigh(weights: F64, values: F64) -> float:
    total = 0.0
    for i in range(weights.size):
        total += weights[i] * values[i]
    return total


@kernel(inline=True)
def deadband_value(x: float, deadbands: Deadbands) -> float:
    """Evaluate the memoryless function Lambda, a weighted sum of deadband operators (6.6)."""
    slope, d_up, g_up, d_down, g_down = deadbands
    total = slope * x
    j = 0
    while j < d_up.size and x > d_up[j]:
        total += g_up[j] * (x - d_up[j])
        j += 1
    j = 0
    while j < d_down.size and x < d_down[j]:
        total += g_down[j] * (x - d_down[j])
        j += 1
    return total


@kernel(inline=True)
def deadband_block(x: F64, deadbands: Deadbands, out: F64) -> None:
    """Evaluate :func:`deadband_value` for each element of ``x`` into ``out``, both float64[n]."""
    for k in range(x.size):
        out[k] = deadband_value(x[k], deadbands)


@kernel()
def play_sum_shared(
    v: F64, widening: F64, direct: float, thresholds: F64, weights: F64, memory: F64, out: F64
) -> None:
    """Sum weighted plays whose widening, float64[n] >= 0, is given for each sample.

    Two mutually inverse sums with the same widening cancel exactly. See :data:`Plays` for
    ``direct``, ``thresholds`` and ``weights``.
    """
    for k in range(v.size):
        now = v[k]
        _move_plays(now, widening[k], thresholds, memory)
        out[k] = direct * now + _weigh(weights, memory)
        memory[thresholds.size] = now


@kernel(inline=True)
def play_sum(v: F64, plays: Plays, memory: F64, out: F64) -> None:
    """Sum weighted plays whose thresholds widen with the rate of the input (3.6, 5.5).

    ``v`` and ``out`` are float64[n].
    """
    rate_gain, direct, thresholds, weights = plays
    for k in range(v.size):
        now = v[k]
        _move_plays(now, _widening(now - memory[thresholds.size], rate_gain), thresholds, memory)
        out[k] = direct * now + _weigh(weights, memory)
        memory[thresholds.size] = now


@kernel()
def play_outputs(v: F64, widening: F64, thresholds: F64, memory: F64, out: F64_2D) -> None:
    """Fill ``out`` (float64[n, m]) with the output of each play, as regressors for identification.

    ``widening`` is float64[n] >= 0, ``thresholds`` float64[m] in the unit of ``v`` (float64[n]).
    """
    for k in range(v.size):
        _move_plays(v[k], widening[k], thresholds, memory)
        for i in range(thresholds.size):
            out[k, i] = memory[i]
        memory[thresholds.size] = v[k]


@kernel()
def stop_sum(v: F64, direct: float, thresholds: F64, weights: F64, memory: F64, out: F64) -> None:
    """Sum weighted stop operators: the stop-operator-based compensator (3.11).

    ``direct`` is w_0, the weight of the input itself; ``thresholds`` (rising, in the unit of ``v``)
    and ``weights`` are float64[m]. ``memory`` is float64[m + 1]: the operators' outputs, then the
    previous input; NaN counts as 0, the input at rest.
    """
    for k in range(v.size):
        now = v[k]
        previous = memory[thresholds.size]
        if math.isnan(previous):
            previous = 0.0
        for i in range(thresholds.size):
            memory[i] = stop_step(now, previous, thresholds[i], memory[i])
        out[k] = direct * now + _weigh(weights, memory)
        memory[thresholds.size] = now


@kernel()
def integrated_forward(v: F64, plays: Plays, deadbands: Deadbands, memory: F64, out: F64) -> None:
    """Run the integrated model Omega[v] = Lambda(Pi[v]) (6.5); ``v`` and ``out`` are float64[n]."""
    play_sum(v, plays, memory, out)
    deadband_block(out, deadbands, out)


@kernel()
def integrated_inverse(y: F64, deadbands: Deadbands, plays: Plays, memory: F64, out: F64) -> None:
    """Run the integrated inverse Omega^-1[y] = Pi^-1[Lambda^-1(y)] (6.17).

    The parameters are those of the inverse operators; ``y`` and ``out`` are float64[n]. The
    previous input in ``memory`` is the input of the plays, Lambda^-1(y).
    """
    deadband_block(y, deadbands, out)
    play_sum(out, plays, memory, out)


@kernel()
def butterfly_forward(
    v: F64, plays: Plays, bias: float, deadbands: Deadbands, memory: F64, out: F64
) -> None:
    """Run S(|Pi[v] + bias|): plays, then an even function; ``v`` and ``out`` are float64[n]."""
    play_sum(v, plays, memory, out)
    for k in range(v.size):
        out[k] = deadband_value(abs(out[k] + bias), deadbands)


@kernel()
def butterfly_inverse(
    y: F64, deadbands: Deadbands, wing: float, bias: float, plays: Plays, memory: F64, out: F64
) -> None:
    """Run the inverse of :func:`butterfly_forward` on one wing, 1.0 or -1.0; y < 0 counts as 0.

    The parameters are those of the inverse operators; ``y`` and ``out`` are float64[n].
    """
    for k in range(y.size):
        out[k] = deadband_value(max(y[k], 0.0), deadbands) * wing - bias
    play_sum(out, plays, memory, out)


def rest_memory(operators: int) -> F64:
    """Return the memory of a number of operators at rest: float64[operators + 1]."""
    memory = np.zeros(operators + 1)
    memory[operators] = np.nan
    return memory
