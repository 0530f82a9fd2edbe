"""Texts from files as people may be shown them."""

import pytest

from hilctl.base.printable import MOST_SHOWN, printable, short_name


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("sine 6 A 10 Hz, µm ü", "sine 6 A 10 Hz, µm ü"),
        ("\x1b[31mred\x07", "\\x1b[31mred\\x07"),
        ("a\r\nb", "a\\r\\nb"),
        ("\u202egnp.exe", "\\u202egnp.exe"),
        ("\x9b2Jc\rd\x7fe", "\\x9b2Jc\\rd\\x7fe"),
    ],
)
def test_what_steers_a_terminal_is_written_out(text: str, shown: str) -> None:
    assert printable(text) == shown


def test_lines_stay_where_they_are_wanted() -> None:
    assert printable("a:\n\tb\r", lines=True) == "a:\n\tb\\r"


def test_names_are_short() -> None:
    assert short_name("x" * MOST_SHOWN) == "x" * MOST_SHOWN
    for long in ("x" * 10**6, "\x1b" * MOST_SHOWN):
        assert len(short_name(long)) == MOST_SHOWN
        assert short_name(long).endswith("...")
