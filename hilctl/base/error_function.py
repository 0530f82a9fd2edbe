"""The error function, without SciPy: to import that takes as long as to judge 10 s at 50 kHz.

Source: S. L. Moshier, Cephes Mathematical Library, ndtr.c, which SciPy's own is, too. Without fused
multiplication and addition both give the same bits; ``math.erf`` differs in the last one.
"""

import math
from collections.abc import Sequence

import numpy as np

from hilctl.base.arrays import F64

_NEAR = (
    (9.60497373987051638749e0, 9.00260197203842689217e1, 2.23200534594684319226e3,
     7.00332514112805075473e3, 5.55923013010394962768e4),
    (1.0, 3.35617141647503099647e1, 5.21357949780152679795e2, 4.59432382970980127987e3,
     2.26290000613890934246e4, 4.92673942608635921086e4),
)  # fmt: skip
"""Of erf(x) / x by x squared up to 1: coefficients above and below, the highest power first."""
_FAR = (
    (2.46196981473530512524e-10, 5.64189564831068821977e-1, 7.46321056442269912687e0,
     4.86371970985681366614e1, 1.96520832956077098242e2, 5.26445194995477358631e2,
     9.34528527171957607540e2, 1.02755188689515710272e3, 5.57535335369399327526e2),
    (1.0, 1.32281951154744992508e1, 8.67072140885989742329e1, 3.54937778887819891062e2,
     9.75708501743205489753e2, 1.82390916687909736289e3, 2.24633760818710981792e3,
     1.65666309194161350182e3, 5.57535340817727675546e2),
)  # fmt: skip
"""Of (1 - erf(x)) exp(x squared) by x from 1 to 8."""
_ONE = 7.0
"""From here on erf(x) is 1."""


def erf(x: F64) -> F64:
    """Return the error function of each number: float64[n].

    Args:
        x: float64[n], none below 0.
    """
    x = np.minimum(x, _ONE)
    squared = x * x
    near = x * _series(_NEAR[0], squared) / _series(_NEAR[1], squared)
    # NumPy's own exponential has other last bits, by the processor's kind.
    falling = np.array([math.exp(-each) for each in squared.tolist()])
    far = 1.0 - falling * _series(_FAR[0], x) / _series(_FAR[1], x)
    return np.where(x <= 1.0, near, far)


def _series(coefficients: Sequence[float], x: F64) -> F64:
    total = np.full_like(x, coefficients[0])
    for each in coefficients[1:]:
        total = total * x + each
    return total
