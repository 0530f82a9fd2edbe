"""Profiles of lines of text: templates and trips. ``test_profile.py`` breaks the other rules."""

from pathlib import Path

import pytest
from pydantic import ValidationError

from hilctl_drivers.ascii.ascii_profile import AsciiProfile, NumberReply, SendStep, fields_of
from hilctl_drivers.profile import load_profile

DCON = load_profile(str(Path(__file__).parents[3] / "data" / "dcon_module.yaml"))


def test_fields_of_a_template():
    assert fields_of("#{address:02X}0{value:+07.3f}") == {"address", "value"}
    assert fields_of("*IDN?") == set()


@pytest.mark.parametrize("text", ["SET {value!r}", "SET {value} µV", "", "SVA 1\n", "\tPOS?"])
def test_templates_that_can_not_be_sent_are_refused(text):
    with pytest.raises(ValidationError, match="text"):
        SendStep(kind="send", text=text)


@pytest.mark.parametrize(("pattern", "example"), [("(>)([0-9.]+)", ">1.0"), (">(.*)", ">one")])
def test_a_number_is_the_one_group_of_its_pattern(pattern, example):
    with pytest.raises(ValidationError, match=r"group"):
        NumberReply(pattern=pattern, example=example)


def test_lines_of_one_write_have_no_gap():
    plain = load_profile("pi_e709").model_dump()
    plain["link"]["min_gap_s"] = 0.005
    with pytest.raises(ValidationError, match="min_gap_s"):
        AsciiProfile.model_validate(plain)


def test_a_trip_that_nobody_can_ask_about_is_not_cleared():
    """The safe value is put out with the trip's end, and must not be where there was none."""
    plain = DCON.model_dump()
    plain["watchdog"]["tripped"] = "none"
    with pytest.raises(ValidationError, match="clear requires tripped"):
        AsciiProfile.model_validate(plain)
