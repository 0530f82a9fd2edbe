"""An operator of plays after a model, its inverse, and the adaptation of its parameters.

The operator is x + g (x - c) + sum w_i (P_i[x] - c_i), in um, with x the sum of a model's output
and an offset: the actuator relative to the model. The offset comes first, so x stays in the range
of the references. It is a Prandtl-Ishlinskii operator, with an exact inverse if 1 + g and all sums
1 + g + w_1 + ... + w_i are above 0: K. Kuhnen and H. Janocha, "Adaptive inverse control of
piezoelectric actuators with hysteresis operators", Proc. European Control Conference (1999).

The adapted parameters are not o, g and w_i, whose regressors are similar, but the coefficients of
successively orthogonalised regressors, so a step or bound of one does not affect another.
"""

import math
from typing import TypeAlias

from hilctl.base.types import F64, F64_2D, I64, U32
from hilctl.kernels.jit import kernel

OFFSET, GAIN, WEIGHTS = range(3)  # indices of the parameters; the weights follow
BOUND, CENTRE, POWER = range(3)  # rows of what belongs to each, see the functions
MIDDLE_UM, HALF_UM, LARGEST_UM, DEAD_UM2, RATE, SMOOTHING, LEAK, COUNT = range(8)
SETTINGS = 8
VALUE, FORM, GRADIENT, FOUND, TOTAL = range(5)  # rows of the state
Operator: TypeAlias = tuple[F64, F64_2D, F64_2D, F64]
"""Constants of an operator with m parameters.

settings    float64[8], see the names above
table       float64[3, m]: bound of each parameter, centre of its regressor before it is
            orthogonalised, and mean square after that; infinite if it is not adapted
shape       float64[m, m], lower triangle: share of the others in each regressor
thresholds  float64[m - 2], rising, in half spans
"""
DelayLines: TypeAlias = tuple[F64, F64, I64]
"""References (float64[d + 1]) and inputs (float64[e + 1]), and the positions in both (int64[2]).

Their lengths d and e are the delays in samples from a reference and an input to its displacement.
"""

_FURTHEST = 4.0  # half spans from the middle: the steps are not designed for inputs beyond


@kernel(inline=True)
def _inverted(
    target: float, part: float, before: F64, after: F64, thresholds: F64, memory: F64
) -> float:
    """Return u with (1 + g) u + sum w_i P_i(u) = target, from the plays' memory [z_1..., u].

    Plays start to move with the input in the order of their thresholds, and each then adds its
    weight to the slope.
    """
    n = thresholds.size
    last: float = memory[n]
    slope: float = 1.0 + before[GAIN] + part * (after[GAIN] - before[GAIN])
    left = target - slope * last
    for i in range(n):
        low, high = before[WEIGHTS + i], after[WEIGHTS + i]
        left -= (low + part * (high - low)) * memory[i]
    sign = math.copysign(1.0, left)
    left, way = abs(left), 0.0
    for i in range(n):
        low, high = before[WEIGHTS + i], after[WEIGHTS + i]
        gap = max(thresholds[i] + sign * (memory[i] - last) - way, 0.0)
        go = min(left / slope, gap)
        way += go
        left -= go * slope
        slope += low + part * (high - low)
    return last + sign * (way + left / slope)


@kernel(inline=True)
def _played(u: float, thresholds: F64, memory: F64) -> float:
    """Move the plays to an input; return it."""
    n = thresholds.size
    for i in range(n):
        memory[i] = max(u - thresholds[i], min(u + thresholds[i], memory[i]))
    memory[n] = u
    return u


@kernel()
def adapted_input(
    input_um: F64, size: int, before: F64, after: F64, operator: Operator, memory: F64
) -> None:
    """Convert requested displacements to a model's input, in place, by the operator's inverse.

    Values of ``input_um``, float64[n], that are not finite stay unchanged and move no play.
    ``before`` and ``after`` ``size`` >= n samples, o, g and w_i are float64[m]; between, they
    change linearly. ``memory`` is float64[m - 1], of the plays.
    """
    settings, table, _shape, thresholds = operator
    middle, half = settings[MIDDLE_UM], settings[HALF_UM]
    for k in range(input_um.size):
        wanted = input_um[k]
        if abs(wanted) < math.inf:
            part = (k + 1.0) / size
            target = wanted - middle
            for j in range(GAIN, before.size):
                target += (before[j] + part * (after[j] - before[j])) * table[CENTRE, j]
            u = _inverted(target / half, part, before, after, thresholds, memory)
            offset = before[OFFSET] + part * (after[OFFSET] - before[OFFSET])
            input_um[k] = middle + half * _played(u, thresholds, memory) - offset


@kernel(inline=True)
def _regressors(x_um: float, operator: Operator, memory: F64, out: F64) -> None:
    """Fill ``out`` (float64[m], um) with the regressors of the adapted parameters."""
    settings, table, shape, thresholds = operator
    half = settings[HALF_UM]
    u = _played((x_um - settings[MIDDLE_UM]) / half, thresholds, memory)
    out[OFFSET] = 1.0
    out[GAIN] = half * u - table[CENTRE, GAIN]
    for i in range(thresholds.size):
        out[WEIGHTS + i] = half * memory[i] - table[CENTRE, WEIGHTS + i]
    for j in range(out.size - 1, -1, -1):  # from the last: those before it are still themselves
        total = out[j]
        for i in range(j):
            total += shape[j, i] * out[i]
        out[j] = total


@kernel()
def regressor_sums(
    input_um: F64, operator: Operator, memory: F64, found: F64, sums: F64, products: F64_2D
) -> None:
    """Add the regressors of an input to ``sums``, float64[m], and their products to ``products``.

    ``memory`` is float64[m - 1], of the plays; ``found`` is scratch, float64[m].
    """
    for k in range(input_um.size):
        _regressors(input_um[k], operator, memory, found)
        for i in range(found.size):
            sums[i] += found[i]
            for j in range(found.size):
                products[i, j] += found[i] * found[j]


@kernel(inline=True)
def _delayed(value: float, line: F64, places: I64, which: int) -> float:
    """Put a value into a delay line and return the oldest one; a line of one returns the value."""
    at = places[which]
    line[at] = value
    at = (at + 1) % line.size
    places[which] = at
    oldest: float = line[at]
    return oldest


@kernel(inline=True)
def _excess(found: F64, table: F64_2D, count: float) -> float:
    """Return the square of the regressors relative to its mean, at least 1."""
    total = 0.0
    for j in range(found.size):
        total += found[j] * found[j] / table[POWER, j]
    return max(1.0, total / count)


@kernel(inline=True)
def _step(size: int, operator: Operator, state: F64_2D) -> None:
    """Move the parameters by ``size`` samples of the smoothed gradient, within their bounds.

    The dead zone applies to the part of the squared error that a gradient explains, because a small
    part may be noise.
    """
    settings, table, shape, _thresholds = operator
    pace, dead = size * settings[RATE], settings[DEAD_UM2]
    for j in range(state.shape[1]):
        bound, gradient = table[BOUND, j], state[GRADIENT, j]
        explained = gradient * gradient / table[POWER, j]
        share = 1.0 - math.sqrt(dead / max(explained, dead, 1e-300))
        most = pace * bound
        step = min(most, max(-most, pace * share * gradient / table[POWER, j]))
        kept = 1.0 - pace * settings[LEAK] * min(j, 1)  # no leakage of the offset
        state[VALUE, j] = min(bound, max(-bound, kept * state[VALUE, j] + step))
    for i in range(state.shape[1]):
        form = state[VALUE, i]
        for j in range(i + 1, state.shape[1]):
            form += shape[j, i] * state[VALUE, j]
        state[FORM, i] = form


@kernel()
def adapt_block(
    reference_um: F64,
    input_um: F64,
    displacement_um: F64,
    flags: U32,
    operator: Operator,
    lines: DelayLines,
    memory: F64,
    state: F64_2D,
) -> int:
    """Compare a block's displacements with the references due, and step the parameters.

    Samples with a flag, displacements caused by the reference or input of such a sample, and errors
    larger than the parameters can cause are ignored, because they show no change of the actuator. A
    block without any other sample changes nothing.

    Args:
        reference_um: float64[n].
        input_um: float64[n], the model's input.
        displacement_um: float64[n].
        flags: uint32[n].
        operator: Its constants.
        lines: Delay lines, NaN for samples to ignore.
        memory: float64[m - 1], of the plays.
        state: float64[5, m], parameters, these as o, g and w_i, smoothed gradient, scratch.

    Returns:
        Number of samples used.
    """
    settings, table = operator[0], operator[1]
    due, shown, places = lines
    found, total = state[FOUND], state[TOTAL]
    size, last, used = reference_um.size, memory.size - 1, 0
    total[:] = 0.0
    for k in range(size):
        flagged = flags[k] != 0
        due_um = _delayed(math.nan if flagged else reference_um[k], due, places, 0)
        shown_um = _delayed(math.nan if flagged else input_um[k], shown, places, 1)
        x_um = shown_um + state[VALUE, OFFSET]
        known = abs(x_um - settings[MIDDLE_UM]) <= _FURTHEST * settings[HALF_UM]  # NaN is not
        if not known:
            x_um = settings[MIDDLE_UM] + settings[HALF_UM] * memory[last]  # moves no play
        _regressors(x_um, operator, memory, found)
        error_um = displacement_um[k] - due_um
        if known and not flagged and abs(error_um) <= settings[LARGEST_UM]:
            error_um /= _excess(found, table, settings[COUNT])
            for j in range(total.size):
                total[j] += found[j] * error_um
            used += 1
    if used:
        part = size * settings[SMOOTHING] / (1.0 + size * settings[SMOOTHING])
        for j in range(total.size):
            state[GRADIENT, j] += (total[j] / size - state[GRADIENT, j]) * part
        _step(size, operator, state)
    return used
