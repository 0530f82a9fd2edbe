"""Conditions on runs: a small part of Python, in which the unknown matches nothing."""

import pytest

from hilctl.analysis.where import RunCondition, check_names
from hilctl.base.errors import InputError

RUN = {
    "frequency_hz": 120.0,
    "name": "sine",
    "simulated": True,
    "reason": None,
    "label.sample": "A7",
    "label.class": 3,
    "label.none": None,
}


def matches(text):
    condition = RunCondition(text)
    assert set(condition.names) <= set(RUN)
    return condition.matches(RUN)


@pytest.mark.parametrize(
    "text",
    [
        'frequency_hz>100 and label.sample=="A7"',
        "100 < frequency_hz <= 120",
        "-1 < frequency_hz",
        'name in ("sine", "chirp")',
        'label.sample in ["A7"]',
        '"in" in name',
        'name not in ["chirp"]',
        'label["class"] == 3',
        "simulated",
        "simulated == True and not simulated == False",
        "not frequency_hz < 100",
        "frequency_hz != 100",
        'label.sample != 7',
        "reason == None and name != None and reason is None",
        "name is not None",
        "reason == 'x' or simulated",
        " ( simulated ) ",
    ],
)  # fmt: skip
def test_what_is_true_matches(text):
    assert matches(text)
    assert not matches(f"not ({text})")


@pytest.mark.parametrize(
    "text",
    [
        'reason == "x"',
        'reason != "x"',
        'reason in ["x"]',
        'reason not in ["x"]',
        'label.none == label.none',
        "label.none > 3",
        'label.sample > 3',
        "name < 3 or reason == 'x'",
        "name and simulated",
        "3 in name",
        'name in frequency_hz',
        "reason == 'x' and simulated",
        "simulated > 0",
    ],
)  # fmt: skip
def test_what_is_not_known_matches_nothing_nor_does_its_contrary(text):
    assert not matches(text)
    assert not matches(f"not ({text})")


@pytest.mark.parametrize("text", ["simulated == 1", "label['class'] == '3'", "name == 'Sine'"])
def test_kinds_and_letters_count(text):
    assert not matches(text)
    assert matches(f"not ({text})")


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("", "can't be read"),
        ("a > > 3", "can't be read at character"),
        ("a = 3", "can't be read"),
        ("a > 1; b", "can't be read"),
        ("__import__('os')", "is no condition"),
        ("(lambda: 1)()", "is no condition"),
        ("a == f(1)", "can't stand here"),
        ("a == [x for x in b]", "can't stand here"),
        ("a == b + 1", "can't stand here"),
        ("a == 9**9**9", "can't stand here"),
        ("a == f'{b}'", "can't stand here"),
        ("a[0] == 1", "is no name"),
        ("'x'.y == 1", "is no name"),
        ("a is 3", "'is' stands before None only"),
        ("1", "is no condition"),
        ("a == b'x'", "can't stand here"),
        ("a == 1j", "can't stand here"),
        ("(x := 3) == 3", "can't stand here"),
        ("\0", "can't be read"),
        ("(" * 500, "can't be read"),
        ("not " * 450 + "a", ""),
        ("a" * 2001, "more than 2000"),
        ("\x1b[2J(", r"\\x1b\[2J"),
    ],
)
def test_anything_else_is_refused_in_a_line(text, problem):
    if not problem:
        assert RunCondition(text).names == {"a": None}
        return
    with pytest.raises(InputError, match=problem) as refused:
        RunCondition(text)
    assert str(refused.value).isprintable()


def test_a_name_that_no_run_can_have_is_refused_with_the_nearest():
    with pytest.raises(InputError, match=r"freqency_hz: .*did you mean frequency_hz\?"):
        check_names(["freqency_hz"], RUN, ["label."])
    with pytest.raises(InputError, match=r"zzz: .*hilctl list --keys"):
        check_names(["zzz"], RUN, ["label."])


def test_a_label_that_no_run_has_is_said(caplog):
    """It may be one of runs to come: nothing matches it."""
    check_names(["label.smaple", "name"], RUN, ["label."])
    assert "no recording here has label.smaple (did you mean label.sample" in caplog.text
    assert len(caplog.records) == 1
