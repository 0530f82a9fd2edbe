"""What errors say, and who is caught by whom."""

import pytest

from hilctl.base import errors
from hilctl.base.errors import ConfigError, ConfigProblem, DeviceError, HilctlError, InputError


@pytest.mark.parametrize(("problem", "text"), [
    (ConfigProblem("a.yaml:3", "limits.slew", "must be > 0"), "a.yaml:3: limits.slew: must be > 0"),
    (ConfigProblem("a.yaml", "", "is empty"), "a.yaml: is empty"),
    (ConfigProblem("a.yaml:3", "x", "must be > 0", "-1", "in A"),
     "a.yaml:3: x: must be > 0, got -1 (in A)"),
])  # fmt: skip
def test_a_problem_has_place_key_rule_value_and_hint(problem, text):
    assert str(problem) == text


def test_all_problems_of_a_file_are_one_error():
    problems = [ConfigProblem("a", "x", "one"), ConfigProblem("b", "y", "two")]
    error = ConfigError(iter(problems))
    assert str(error) == "a: x: one\nb: y: two"
    assert error.problems == tuple(problems)


def test_what_the_user_gave_is_told_from_what_happened():
    """Exit codes are by these two: bad input ends with 2, a run that failed with 3."""
    found = {c for c in vars(errors).values() if isinstance(c, type) and issubclass(c, Exception)}
    assert all(issubclass(each, HilctlError) for each in found)
    assert not issubclass(DeviceError, InputError)
    assert issubclass(ConfigError, InputError)
