"""Figures as files, and as SVG of a page."""

import xml.etree.ElementTree as ET

import pytest

from hilctl.analysis.figure_export import formats_of, svg, write_figure
from hilctl.analysis.figure_layout import FigureSpec, Panel, drawn
from hilctl.base.errors import InputError

NASTY = "<script>alert(1)</script> $x$ & 'y'"


@pytest.fixture
def figure():
    return drawn(FigureSpec("a", "", (Panel(lambda axes: axes.plot([0, 1], [0, 1]), NASTY),)))


def test_a_page_s_figure_has_texts_of_any_width_and_no_address(figure):
    text = svg(figure)
    root = ET.fromstring(text)
    assert root.attrib["viewBox"].startswith("0 0 ")
    assert "width" not in root.attrib
    assert "http" not in text
    shown = " ".join("".join(element.itertext()) for element in root.iter("text"))
    assert "<script>alert(1)</script>" in shown
    assert "<script>" not in text
    assert '<g id="' not in text


def test_the_same_figure_has_the_same_bytes(figure):
    assert svg(figure) == svg(figure)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "head"), [("svg", b"<?xml"), ("pdf", b"%PDF"), ("png", b"\x89PNG")]
)
def test_files_are_of_their_kind(figure, tmp_path, kind, head):
    paths = write_figure(figure, tmp_path, "loops", [kind], overwrite=False)
    assert paths == [tmp_path / f"loops.{kind}"]
    assert paths[0].read_bytes().startswith(head)
    with pytest.raises(InputError, match="exists already"):
        write_figure(figure, tmp_path, "loops", [kind], overwrite=False)


def test_formats_are_read_from_a_list():
    assert formats_of("SVG, png,svg") == ("svg", "png")
    for wrong in ("", "gif", "svg,jpg"):
        with pytest.raises(InputError, match="--format: must be of svg, pdf, png"):
            formats_of(wrong)
