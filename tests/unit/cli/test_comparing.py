"""Frequencies given on the command line of a comparison."""

import pytest

from hilctl.base.errors import InputError
from hilctl.cli.comparing import _numbers


def test_frequencies_are_numbers():
    """The command line's list of frequencies."""
    assert _numbers(None) is None
    assert _numbers("1, 2.5,1e2") == [1.0, 2.5, 100.0]
    with pytest.raises(InputError, match="numbers with commas"):
        _numbers("ten")
