"""Common types of the experiment file: names, intervals, and the ring that bridges flushes."""

import pytest
from pydantic import TypeAdapter, ValidationError

from hilctl.experiment.sections import Interval, Limits, Name, PiFeedbackConfig, RecordingConfig

NAME, INTERVAL = TypeAdapter(Name), TypeAdapter(Interval)


@pytest.mark.parametrize("text", ["a", "9.x_y-z", "a" * 80])
def test_names_that_can_be_file_names(text):
    assert NAME.validate_python(text) == text


@pytest.mark.parametrize("text", ["", ".hidden", "a b", "a/b", "../a", "a" * 81, "ä", "a\n"])
def test_other_names_are_refused(text):
    """A recording is named after its experiment."""
    with pytest.raises(ValidationError, match="at most 80 letters"):
        NAME.validate_python(text)


@pytest.mark.parametrize("given", [(1.0,), (1.0, 2.0, 3.0), (2.0, 1.0), (1.0, 1.0)])
def test_an_interval_is_two_rising_numbers(given):
    assert INTERVAL.validate_python((1.0, 2.0)) == (1.0, 2.0)
    with pytest.raises(ValidationError, match=r"must be \[lowest, highest\]"):
        INTERVAL.validate_python(given)


def test_the_ring_bridges_three_flushes():
    """One that is being written, one that waits, and one that fills."""
    assert RecordingConfig(flush_s=2.0, ring_s=6.0).ring_s == 6.0
    with pytest.raises(ValidationError, match="at least three times flush_s"):
        RecordingConfig(flush_s=2.0, ring_s=5.9)


@pytest.mark.parametrize("way", [{"bandwidth_hz": 5.0}, {"ki_per_s": 3.0},
                                 {"ki_per_s": 3.0, "kp": 0.0}])  # fmt: skip
def test_one_way_of_feedback_is_enough(way):
    assert PiFeedbackConfig(limit_um=1.0, **way).limit_um == 1.0


@pytest.mark.parametrize("ways", [{}, {"kp": 0.1}, {"bandwidth_hz": 5.0, "ki_per_s": 3.0},
                                  {"bandwidth_hz": 5.0, "kp": 0.1}])  # fmt: skip
def test_no_way_of_feedback_and_both_are_refused(ways):
    with pytest.raises(ValidationError, match="must have either bandwidth_hz or ki_per_s"):
        PiFeedbackConfig(limit_um=1.0, **ways)


STROKE = {"stroke_um": (-50.0, 50.0)}
CURRENT = {"peak_current_a": 7.0, "slew_a_per_s": 1e4}
VOLTAGE = {"drive_v": (-20.0, 120.0), "slew_v_per_s": 2e4}


def test_a_peak_current_counts_both_ways_and_a_drive_as_it_is():
    current, voltage = Limits(**STROKE, **CURRENT), Limits(**STROKE, **VOLTAGE)
    assert (current.unit, current.command_range, current.slew_per_s) == ("A", (-7.0, 7.0), 1e4)
    assert (voltage.unit, voltage.command_range, voltage.slew_per_s) == ("V", (-20.0, 120.0), 2e4)


@pytest.mark.parametrize("given", [{}, {"peak_current_a": 7.0}, {"slew_v_per_s": 2e4},
                                   {**CURRENT, "drive_v": (0.0, 1.0)},
                                   {**CURRENT, **VOLTAGE}])  # fmt: skip
def test_incomplete_and_mixed_limits_are_refused(given):
    """Half a limiter is none."""
    with pytest.raises(ValidationError, match="must have either peak_current_a and slew_a_per_s"):
        Limits(**STROKE, **given)
