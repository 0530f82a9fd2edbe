"""What reaches the terminal as it is, and what replay prints: the same bits, or others."""

from dataclasses import replace

import pytest
from rich.console import Group
from rich.table import Table
from rich.text import Text

from hilctl.analysis.replay import ReplayResult
from hilctl.cli.console import print_replay, print_rich
from hilctl.cli.streams import plain_streams

SAME = ReplayResult(
    samples=900, left_out_samples=0, identical=True, first_difference=None, differing_samples=0,
    largest_difference=0.0, rms_difference=0.0, command_unit="A", command_min=-1.5,
    command_max=2.25, limited_samples=7,
)  # fmt: skip
OTHER = replace(
    SAME, identical=False, first_difference=12, differing_samples=3, largest_difference=0.5
)


@pytest.fixture
def shown(monkeypatch, capsys):
    """Return a function that gives what a terminal of 120 columns gets."""
    monkeypatch.setenv("COLUMNS", "120")

    def of(result, **more):
        print_replay(result, **{"other": None, **more})
        return capsys.readouterr().out

    return of


def test_the_same_bits_are_one_line(shown):
    assert shown(SAME) == "identical: 900 commands, bit for bit\n"


def test_other_bits_are_counted_and_placed(shown):
    text = shown(OTHER)
    assert "different: 3 of 900 commands, the first at sample 12" in text
    assert "largest difference 0.5 A" in text


def test_another_model_is_never_called_identical(shown, tmp_path):
    """What it would have done is said with its range, and not judged."""
    text = shown(SAME, other="m.yaml")
    assert "identical" not in text
    assert "with m.yaml the command would have run from -1.5 to 2.25 A, 7 samples limited" in text


def test_samples_behind_lost_ones_are_told(shown):
    assert shown(replace(SAME, left_out_samples=50)).startswith("50 samples behind lost ones")


@pytest.fixture
def printed(monkeypatch, capsys):
    """Return a function that gives what a terminal with colours gets."""
    monkeypatch.setenv("COLUMNS", "120")
    monkeypatch.setenv("FORCE_COLOR", "1")
    monkeypatch.setenv("TERM", "xterm")

    def of(renderable):
        with plain_streams():
            print_rich(renderable)
        return capsys.readouterr().out

    return of


def test_nothing_is_taken_for_markup(printed):
    """File names and labels may look like markup, or like the name of a picture."""
    table = Table("[/x]", title="[red]a[/]")
    table.add_row(":smile: [/b]")
    text = printed(table)
    assert all(each in text for each in ("[/x]", "[red]a[/]", ":smile: [/b]"))


def test_styles_are_sent_and_control_characters_shown(printed):
    """Wherever the text stands: alone, styled, in a cell or in a title."""
    hostile = "a\x1b[2Jb"
    table = Table(hostile, title=Text(hostile))
    table.add_row(Text(hostile, "green"))
    text = printed(Group(hostile, table))
    assert "\x1b[32m" in text
    assert text.count(r"a\x1b") == 4  # a cell is cut where it was measured before
    assert "\x1b[2J" not in text
