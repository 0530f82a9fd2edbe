"""The generalised Prandtl-Ishlinskii model: plays with envelope functions, and its inverse.

A generalised play has the output ``max(gamma_l(v) - r, min(gamma_r(v) + r, held))`` (1.17). If
``gamma_l <= gamma_r``, all of them are ordinary plays of one signal z, the generalised play of
threshold 0. Therefore the model is a sum of plays of z, and its inverse is the inverse sum of plays
before the inverse envelopes. Each envelope is ``c tanh(k v + s) + o``; the falling one follows the
rising one instead of going below it.

Memory, float64[m + 2]: m play outputs, z, then the previous command (NaN: none yet, which is 0).
It is updated in place, so any division into blocks gives the same bits. Signals are float64[n].

Source: section 2.2.6 of "Modeling and Compensation of Rate-Dependent Asymmetric Hysteresis
Nonlinearities of Magnetostrictive Actuators", Concordia; equation numbers are that dissertation's.
"""

import math
from typing import TypeAlias

from hilctl.base.types import F64, F64_2D
from hilctl.kernels.jit import kernel

Envelopes: TypeAlias = tuple[F64, F64]
"""gamma_l and gamma_r: c, k, s and o of each, float64[4], with c and k > 0."""
EnvelopedPlays: TypeAlias = tuple[float, F64, F64]
"""p_0, thresholds (rising, in the unit of the envelopes) and weights, float64[m] each."""
_SATURATED = 1.0 - 1e-12


@kernel(inline=True)
def _envelope(v: float, shape: F64) -> float:
    return float(shape[0] * math.tanh(shape[1] * v + shape[2]) + shape[3])


@kernel(inline=True)
def _inverse_envelope(z: float, shape: F64) -> float:
    level = (z - shape[3]) / shape[0]
    level = min(max(level, -_SATURATED), _SATURATED)
    return float((math.atanh(level) - shape[2]) / shape[1])


@kernel(inline=True)
def _hold(v: float, held: float, envelopes: Envelopes) -> float:
    rising, falling = envelopes
    low = _envelope(v, rising)
    high = max(low, _envelope(v, falling))
    return max(low, min(high, held))


@kernel(inline=True)
def _sum_of_plays(z: float, plays: EnvelopedPlays, memory: F64) -> float:
    direct, thresholds, weights = plays
    total = direct * z
    for i in range(thresholds.size):
        memory[i] = max(min(memory[i], z + thresholds[i]), z - thresholds[i])
        total += weights[i] * memory[i]
    return total


@kernel()
def envelope_forward(
    v: F64, envelopes: Envelopes, plays: EnvelopedPlays, memory: F64, out: F64
) -> None:
    """Run the generalised model (1.20)."""
    m = memory.size - 2
    for k in range(v.size):
        now = v[k]
        z = _hold(now, memory[m], envelopes)
        out[k] = _sum_of_plays(z, plays, memory)
        memory[m] = z
        memory[m + 1] = now


@kernel()
def envelope_outputs(
    v: F64, envelopes: Envelopes, thresholds: F64, memory: F64, out: F64_2D
) -> None:
    """Compute z and the output of each play separately, as regressors for identification.

    ``thresholds`` are those of :data:`EnvelopedPlays`; ``out`` is float64[n, m + 1], z first.
    """
    m = thresholds.size
    for k in range(v.size):
        z = _hold(v[k], memory[m], envelopes)
        memory[m] = z
        memory[m + 1] = v[k]
        out[k, 0] = z
        for i in range(m):
            memory[i] = max(min(memory[i], z + thresholds[i]), z - thresholds[i])
            out[k, i + 1] = memory[i]


@kernel()
def envelope_inverse(
    y: F64,
    envelopes: Envelopes,
    span: tuple[float, float],
    plays: EnvelopedPlays,
    memory: F64,
    out: F64,
) -> None:
    """Run the inverse: the inverse sum of plays, then the inverse envelopes.

    The command follows the inverse of gamma_l while z rises, and the inverse of gamma_r while z
    falls. It jumps when z turns, and is constant while z is constant. ``y`` is float64[n],
    displacement in um; commands stay within ``span``. ``plays`` are those of the inverse sum, with
    thresholds in um.
    """
    rising, falling = envelopes
    low, high = span
    m = memory.size - 2
    for k in range(y.size):
        z = _sum_of_plays(y[k], plays, memory)
        upper = _inverse_envelope(z, rising)
        lower = min(upper, _inverse_envelope(z, falling))
        held = 0.0 if math.isnan(memory[m + 1]) else memory[m + 1]
        held = upper if z > memory[m] else (lower if z < memory[m] else held)
        now = max(low, min(high, max(lower, min(upper, held))))
        memory[m] = z
        memory[m + 1] = now
        out[k] = now
