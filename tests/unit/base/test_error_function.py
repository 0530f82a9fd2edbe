"""The error function, against SciPy's."""

import numpy as np
from scipy import special

from hilctl.base.error_function import erf


def test_it_is_scipys_to_the_last_bit():
    """Of a processor that fuses multiplication and addition SciPy's may differ by one."""
    x = np.concatenate((np.linspace(0.0, 10.0, 5001), [1e-300, 1.0, np.nextafter(1.0, 2.0), 1e300]))
    np.testing.assert_array_max_ulp(erf(x), special.erf(x), maxulp=1)


def test_it_ends_at_one():
    assert erf(np.array([0.0, 7.0, np.inf])).tolist() == [0.0, 1.0, 1.0]
