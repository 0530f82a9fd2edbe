"""How the loop's process asks for real time."""

import pytest
from pydantic import ValidationError

from hilctl.machine.settings import Realtime


def test_none_is_a_word():
    """YAML's ``cpu: none`` means any CPU; a number means that one."""
    assert Realtime.model_validate({"cpu": "none"}).cpu is None
    assert Realtime.model_validate({"cpu": 0}).cpu == 0


@pytest.mark.parametrize("given", [{"priority": 0}, {"priority": 99}, {"cpu": -1}, {"cpu": "any"},
                                   {"require": "yes"}])  # fmt: skip
def test_the_highest_priority_is_left_to_the_kernel(given):
    """99 belongs to migration and watchdog threads."""
    with pytest.raises(ValidationError):
        Realtime.model_validate(given)
