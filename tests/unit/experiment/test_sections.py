"""Common types of the experiment file: names, intervals, and the ring that bridges flushes."""

from pathlib import Path

import pytest
from pydantic import TypeAdapter, ValidationError

from hilctl.base.errors import ConfigError
from hilctl.experiment import sections
from hilctl.experiment.load import load_experiment

NAME, INTERVAL = TypeAdapter(sections.Name), TypeAdapter(sections.Interval)


@pytest.mark.parametrize("text", ["a", "9.x_y-z", "a" * 80])
def test_names_that_can_be_file_names(text):
    assert NAME.validate_python(text) == text


@pytest.mark.parametrize("text", ["", ".hidden", "a b", "a/b", "../a", "a" * 81, "ä", "a\n"])
def test_other_names_are_refused(text):
    with pytest.raises(ValidationError, match="at most 80 letters"):
        NAME.validate_python(text)


@pytest.mark.parametrize("given", [(1.0,), (1.0, 2.0, 3.0), (2.0, 1.0), (1.0, 1.0)])
def test_an_interval_is_two_rising_numbers(given):
    assert INTERVAL.validate_python((1.0, 2.0)) == (1.0, 2.0)
    with pytest.raises(ValidationError, match=r"must be \[lowest, highest\]"):
        INTERVAL.validate_python(given)


def test_the_ring_bridges_three_flushes():
    assert sections.RecordingConfig(flush_s=2.0, ring_s=6.0).ring_s == 6.0
    with pytest.raises(ValidationError, match="flush_s"):
        sections.RecordingConfig(flush_s=2.0, ring_s=5.9)


@pytest.mark.parametrize("way", [{"bandwidth_hz": 5.0}, {"ki_per_s": 3.0},
                                 {"ki_per_s": 3.0, "kp": 0.0}])  # fmt: skip
def test_one_way_of_feedback_is_enough(way):
    assert sections.PiFeedbackConfig(limit_um=1.0, **way).limit_um == 1.0


@pytest.mark.parametrize("ways", [{}, {"kp": 0.1}, {"bandwidth_hz": 5.0, "ki_per_s": 3.0},
                                  {"bandwidth_hz": 5.0, "kp": 0.1}])  # fmt: skip
def test_no_way_of_feedback_and_both_are_refused(ways):
    with pytest.raises(ValidationError, match="either bandwidth_hz"):
        sections.PiFeedbackConfig(limit_um=1.0, **ways)


STROKE = {"stroke_um": (-50.0, 50.0)}
CURRENT = {"peak_current_a": 7.0, "slew_a_per_s": 1e4}
VOLTAGE = {"drive_v": (-20.0, 120.0), "slew_v_per_s": 2e4}


def test_a_peak_current_counts_both_ways_and_a_drive_as_it_is():
    current, voltage = sections.Limits(**STROKE, **CURRENT), sections.Limits(**STROKE, **VOLTAGE)
    assert (current.unit, current.command_range, current.slew_per_s) == ("A", (-7.0, 7.0), 1e4)
    assert (voltage.unit, voltage.command_range, voltage.slew_per_s) == ("V", (-20.0, 120.0), 2e4)


@pytest.mark.parametrize("given", [{}, {"peak_current_a": 7.0}, {"slew_v_per_s": 2e4},
                                   {**CURRENT, "drive_v": (0.0, 1.0)},
                                   {**CURRENT, "drive_a": (0.0, 1.0)},
                                   {**CURRENT, **VOLTAGE}])  # fmt: skip
def test_incomplete_and_mixed_limits_are_refused(given):
    with pytest.raises(ValidationError, match="peak_current_a"):
        sections.Limits(**STROKE, **given)


DEMO = Path(__file__).parents[3] / "configs" / "demo.yaml"
LABELS = TypeAdapter(sections.Labels)


def test_texts_and_numbers_stay_what_they_are():
    given = {"sample": "A7", "temperature_c": 21.5, "count": 3, "note": "x" * sections.LONGEST_TEXT}
    kept = LABELS.validate_python(given)
    assert kept == given
    assert isinstance(kept["count"], int)


@pytest.mark.parametrize(("labels", "rule"), [
    ({"a": True}, "must be text or a number"),
    ({"a": None}, "must be text or a number"),
    ({"a": "x" * (sections.LONGEST_TEXT + 1)}, "must have at most 500 characters"),
    ({"a b": 1}, "a key must be at most 40 letters"),
    ({"9a": 1}, "a key must be at most 40 letters"),
    ({"a" * 41: 1}, "a key must be at most 40 letters"),
    ({f"a{n}": n for n in range(sections.MOST_LABELS + 1)}, "must be at most 32: there are 33"),
])  # fmt: skip
def test_what_is_no_label_is_refused(labels, rule):
    with pytest.raises(ValidationError, match=rule):
        LABELS.validate_python(labels)


@pytest.mark.parametrize(("text", "value"), [
    ("sample=A7", "A7"),
    ("serial=0012", "0012"),  # a number would lose its zeros
    ("t=-21.5", -21.5),
    ("n=3", 3),
    ("x=1e3", 1000.0),
    ("note=a: [b], \"c\" = 'd' #e", "a: [b], \"c\" = 'd' #e"),
    ("empty=", ""),
    ("lines=a\nb\u202e\x1b", "a\nb\u202e\x1b"),
    ("flag=true", "true"),
])  # fmt: skip
def test_a_label_of_the_command_line_stands_as_it_was_typed(text, value):
    labels = load_experiment(DEMO, sections.label_settings([text])).config.labels
    assert labels == {text.partition("=")[0]: value}
    assert type(*labels.values()) is type(value)


def test_labels_of_the_command_line_join_those_of_the_file():
    settings = ["labels={sample: A1, operator: Ann}", *sections.label_settings(["sample=A7"])]
    assert load_experiment(DEMO, settings).config.labels == {"sample": "A7", "operator": "Ann"}


def test_all_that_are_none_are_listed():
    with pytest.raises(ConfigError) as refused:
        sections.label_settings(["sample", "a=1", "a.b=2"])
    assert [each.where for each in refused.value.problems] == ["--label sample", "--label a.b=2"]
