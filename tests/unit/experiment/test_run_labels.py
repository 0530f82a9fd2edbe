"""Labels: free keys, texts and numbers, bounded; from the command line as from the file."""

from pathlib import Path

import pytest
from pydantic import TypeAdapter, ValidationError

from hilctl.base.errors import ConfigError
from hilctl.experiment.load import load_experiment
from hilctl.experiment.run_labels import LONGEST_TEXT, MOST_LABELS, Labels, label_settings

DEMO = Path(__file__).parents[3] / "configs" / "demo.yaml"
LABELS = TypeAdapter(Labels)


def test_texts_and_numbers_stay_what_they_are():
    given = {"sample": "A7", "temperature_c": 21.5, "count": 3, "note": "x" * LONGEST_TEXT}
    kept = LABELS.validate_python(given)
    assert kept == given
    assert isinstance(kept["count"], int)


@pytest.mark.parametrize(
    ("labels", "rule"),
    [
        ({"a": True}, "must be text or a number"),
        ({"a": None}, "must be text or a number"),
        ({"a": "x" * (LONGEST_TEXT + 1)}, "must have at most 500 characters"),
        ({"a b": 1}, "a key must be at most 40 letters"),
        ({"9a": 1}, "a key must be at most 40 letters"),
        ({"a" * 41: 1}, "a key must be at most 40 letters"),
        ({f"a{n}": n for n in range(MOST_LABELS + 1)}, "must be at most 32: there are 33"),
    ],
)
def test_what_is_no_label_is_refused(labels, rule):
    with pytest.raises(ValidationError, match=rule):
        LABELS.validate_python(labels)


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("sample=A7", "A7"),
        ("serial=0012", "0012"),  # a number would lose its zeros
        ("t=-21.5", -21.5),
        ("n=3", 3),
        ("x=1e3", 1000.0),
        ("note=a: [b], \"c\" = 'd' #e", "a: [b], \"c\" = 'd' #e"),
        ("empty=", ""),
        ("lines=a\nb\u202e\x1b", "a\nb\u202e\x1b"),
        ("flag=true", "true"),
    ],
)
def test_a_label_of_the_command_line_stands_as_it_was_typed(text, value):
    labels = load_experiment(DEMO, label_settings([text])).config.labels
    assert labels == {text.partition("=")[0]: value}
    assert type(*labels.values()) is type(value)


def test_labels_of_the_command_line_join_those_of_the_file():
    settings = ["labels={sample: A1, operator: Ann}", *label_settings(["sample=A7"])]
    assert load_experiment(DEMO, settings).config.labels == {"sample": "A7", "operator": "Ann"}


def test_all_that_are_none_are_listed():
    with pytest.raises(ConfigError) as refused:
        label_settings(["sample", "a=1", "a.b=2"])
    assert [each.where for each in refused.value.problems] == ["--label sample", "--label a.b=2"]
