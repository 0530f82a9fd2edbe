"""A user's own keys of a run, in the file and on the command line."""

from pathlib import Path

import pytest
from pydantic import ConfigDict, TypeAdapter, ValidationError

from hilctl.base.errors import ConfigError
from hilctl.experiment.load import load_experiment
from hilctl.experiment.sections.labels import LONGEST_TEXT, MOST_LABELS, Labels, label_settings

DEMO = Path(__file__).parents[4] / "configs" / "demo.yaml"
LABELS = TypeAdapter(Labels, config=ConfigDict(strict=True))


@pytest.mark.parametrize("given", [
    {"a": True}, {"a": None}, {"a": "x" * (LONGEST_TEXT + 1)},
    {"a b": 1}, {"9a": 1}, {"a" * 41: 1},
    {f"a{n}": n for n in range(MOST_LABELS + 1)},
])  # fmt: skip
def test_what_is_no_label_is_refused(given):
    with pytest.raises(ValidationError):
        LABELS.validate_python(given)


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
    found = load_experiment(DEMO, label_settings([text])).config.labels
    assert found == {text.partition("=")[0]: value}
    assert type(*found.values()) is type(value)


def test_labels_of_the_command_line_join_those_of_the_file():
    settings = ["labels={sample: A1, operator: Ann}", *label_settings(["sample=A7"])]
    assert load_experiment(DEMO, settings).config.labels == {"sample": "A7", "operator": "Ann"}


def test_all_that_are_none_are_listed():
    with pytest.raises(ConfigError) as refused:
        label_settings(["sample", "a=1", "a.b=2"])
    assert [each.where for each in refused.value.problems] == ["--label sample", "--label a.b=2"]
