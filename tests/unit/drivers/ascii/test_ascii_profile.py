"""Profiles of lines of text: templates, patterns, and replies that can be told apart."""

from pathlib import Path

import pytest
from pydantic import ValidationError

from hilctl_drivers.ascii.ascii_profile import (
    AsciiOutput,
    AsciiProfile,
    NumberReply,
    SendStep,
    fields_of,
)
from hilctl_drivers.profile import load_profile

DCON = load_profile(str(Path(__file__).parents[3] / "data" / "dcon_module.yaml"))


def test_fields_of_a_template():
    assert fields_of("#{address:02X}0{value:+07.3f}") == {"address", "value"}
    assert fields_of("*IDN?") == set()


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("SET {volts}", r"fields must be of \{value\}, \{safe\}, \{address\}, \{timeout\}"),
        ("SET {value!r}", "fields must be of"),
        ("SET\t{value}", "must be printable ASCII"),
        ("SET {value} µV", "must be printable ASCII"),
        ("", "at least 1 character"),
    ],
)
def test_templates_that_can_not_be_sent_are_refused(text, said):
    with pytest.raises(ValidationError, match=said):
        SendStep(kind="send", text=text)


@pytest.mark.parametrize(
    ("pattern", "example", "said"),
    [
        (">([0-9.]+)", "<1.0", "must match the example"),
        (">[0-9.]+", ">1.0", "must have one group, around the number"),
        ("(>)([0-9.]+)", ">1.0", "must have one group"),
        (">(.*)", ">one", "the group must hold a number, got 'one'"),
        ("(", ">1.0", "must be a regular expression"),
    ],
)
def test_a_number_is_the_one_group_of_its_pattern(pattern, example, said):
    with pytest.raises(ValidationError, match=said):
        NumberReply(pattern=pattern, example=example)


def test_an_output_is_written_with_its_value():
    with pytest.raises(ValidationError, match=r"\{value\}"):
        AsciiOutput(write="OUT ON", reply="none", unit="V", min=0.0, max=1.0)


def test_an_error_must_not_look_like_a_good_reply():
    """Else every command would fail, or none."""
    errors = ({"pattern": ".?", "example": "", "meaning": "trouble"},)
    with pytest.raises(ValidationError, match="reply of outputs"):
        AsciiProfile.model_validate({**DCON.model_dump(), "errors": errors})


def test_a_strict_watchdog_has_what_feeds_it():
    plain = DCON.model_dump()
    plain["watchdog"]["feed"] = ()
    with pytest.raises(ValidationError, match="kick: strict"):
        AsciiProfile.model_validate(plain)


def test_a_trip_that_nobody_can_ask_about_is_not_cleared():
    """The safe value is put out with the trip's end, and must not be where there was none."""
    plain = DCON.model_dump()
    plain["watchdog"]["tripped"] = "none"
    with pytest.raises(ValidationError, match="clear needs tripped"):
        AsciiProfile.model_validate(plain)
