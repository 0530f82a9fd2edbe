"""The safe value, and the output that a run begins with."""

from dataclasses import replace
from types import SimpleNamespace
from unittest.mock import Mock

import pytest

from hilctl.base.device import DeviceInfo
from hilctl.base.errors import DeviceError, InputError
from hilctl.experiment.sections.safe import Safe, start_warnings, starting_output
from tests.unit.experiment.test_preflight import CURRENT, checked, refusals, told

INFO = DeviceInfo("rig", "a rig", "A", -10.0, 10.0, -75.0, 75.0, 1e3)


@pytest.mark.parametrize(("reads", "at_start", "warnings"), [
    (True, None, 0), (False, 0.5, 0), (False, None, 1),
])  # fmt: skip
def test_an_output_that_cannot_be_read_is_told(reads, at_start, warnings):
    found = start_warnings(Safe(at_start=at_start), replace(INFO, reads_output=reads))
    assert len(found) == warnings


@pytest.mark.parametrize("at_start", [-8.0, 8.0])
def test_a_start_within_the_device_s_range_is_taken(at_start):
    assert checked(CURRENT, f"safe.at_start={at_start}").loaded.config.safe.at_start == at_start


def test_a_start_that_the_device_can_not_hold_is_refused():
    assert told(refusals(CURRENT, "safe.at_start=8.5")) == [("safe.at_start", "8.5")]


def device(output):
    return SimpleNamespace(info=INFO, output=lambda: output)


@pytest.mark.parametrize("output", [-10.0, -7.0, 0.0, 10.0])
@pytest.mark.parametrize("at_start", [None, 3.0])
def test_what_the_device_says_goes_first(output, at_start):
    assert starting_output(device(output), at_start) == output


def test_what_is_vouched_for_stands_in_for_what_is_not_known():
    assert starting_output(device(None), 3.0) == 3.0


def test_an_unknown_output_is_refused_by_the_key_that_would_say_it():
    with pytest.raises(InputError) as caught:
        starting_output(device(None), None)
    assert str(caught.value).startswith("safe.at_start is required: rig")
    assert str(caught.value).endswith("in A; nothing has moved")


@pytest.mark.parametrize("output", [10.1, -10.1, float("nan"), float("inf")])
def test_an_output_that_no_command_gives_is_refused(output):
    with pytest.raises(InputError, match=r"rig: .* -10 to 10 A"):
        starting_output(device(output), None)


@pytest.mark.parametrize("output", [10.00001, -10.00001])
def test_a_rounded_end_of_the_range_is_the_end(output):
    """A command beyond it would be refused by the device."""
    assert starting_output(device(output), None) == pytest.approx(output)
    assert abs(starting_output(device(output), None)) == 10.0


def test_a_device_that_does_not_answer_is_no_refusal():
    with pytest.raises(DeviceError, match="no answer"):
        starting_output(
            SimpleNamespace(info=INFO, output=Mock(side_effect=DeviceError("no answer"))), 0.0
        )
