"""Parts of pages."""

import pytest

from hilctl.analysis import html
from hilctl.analysis.figure_layout import FigureSpec, Panel
from hilctl.analysis.html import DEFINITIONS, definitions_of

NASTY = "<b onclick='x'>&\x1b"


def test_no_part_takes_a_text_for_markup():
    parts = [
        html.paragraph(NASTY, "note"),
        html.rows(NASTY, [(NASTY, NASTY)]),
        html.grid([NASTY], [[NASTY]]),
        html.details(NASTY, NASTY),
        html.definitions(NASTY, [(NASTY, NASTY)]),
    ]
    for part in parts:
        assert "<b " not in part
        assert "\x1b" not in part
        assert "&lt;b onclick" in part


@pytest.mark.usefixtures("undrawn")
def test_figures_stand_with_their_captions():
    text = html.figures([FigureSpec("a", "what it <shows>", (Panel(lambda axes: None),))])
    assert text.count("<figure") == text.count("</figure>") == 1
    assert 'aria-label="what it &lt;shows&gt;"' in text
    assert "<figcaption>what it &lt;shows&gt;</figcaption>" in text


def test_a_page_is_readable_in_the_dark_on_paper_and_on_a_phone():
    page = html.document("t", ["<p>x</p>"])
    for needed in ("prefers-color-scheme: dark", "@media print", 'name="viewport"'):
        assert needed in page
    assert page.endswith("<p>x</p>\n</body></html>\n")


def test_terms_are_found_in_the_order_of_the_list():
    assert [term for term, _ in definitions_of("loop area", "average cycle")] == [
        "average cycle",
        "loop area",
    ]


def test_every_term_is_defined_once_in_a_sentence():
    assert len({term for term, _ in DEFINITIONS}) == len(DEFINITIONS)
    assert all(meaning.endswith(".") for _, meaning in DEFINITIONS)
