"""Parts of pages."""

import re
import xml.etree.ElementTree as ET

import pytest

from hilctl.lab.pages import html
from hilctl.lab.pages.figure_layout import FigureSpec, Panel, drawn

SCRIPT = "<script>alert(1)</script> $x$ & 'y'"
NASTY = "<b onclick='x'>&\x1b"


def test_texts_are_escaped():
    parts = [
        html.paragraph(NASTY, "note"),
        html.rows(NASTY, [(NASTY, NASTY)]),
        html.grid([NASTY], [[NASTY]]),
        html.details(NASTY, NASTY),
        html.document(NASTY, []),
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


def test_terms_are_found_in_the_order_of_the_list():
    found = html.definitions("loop area", "average cycle", "no term")
    assert re.findall("<dt>(.*?)</dt>", found) == ["average cycle", "loop area"]
    assert not html.definitions("no term")


@pytest.fixture
def figure():
    return drawn(FigureSpec("a", "", (Panel(lambda axes: axes.plot([0, 1], [0, 1]), SCRIPT),)))


def test_a_page_s_figure_has_texts_of_any_width_and_no_address(figure):
    text = html.svg(figure, "loop")
    root = ET.fromstring(text)
    assert root.attrib["viewBox"].startswith("0 0 ")
    assert "width" not in root.attrib
    assert "http" not in text
    shown = " ".join("".join(element.itertext()) for element in root.iter("text"))
    assert "<script>alert(1)</script>" in shown
    assert "<script>" not in text
    assert '<g id="' not in text


def test_a_table_shows_the_kind_of_each_column():
    table = ET.fromstring(
        html.grid(["at", "ms", "file"], [["1 A", "-", "a-1"], ["", "2e-05", "b"]])
    )
    assert [cell.attrib["class"] for cell in table.iter("th")] == ["text", "number", "word"]
    assert len(table.findall("table/thead")) == 1
