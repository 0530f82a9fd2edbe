"""Figures for any column's width."""

import pytest

from hilctl.base.errors import InputError
from hilctl.lab.pages.figure_layout import (
    COLUMN_MM,
    FigureSpec,
    Panel,
    drawn,
    formats_of,
    write_figure,
)


def draw(axes, label="a line"):
    axes.plot([0.0, 1.0], [0.0, 2.0], label=label)
    axes.set(xlabel="time, s", ylabel="displacement, µm")


def panels(count, **keys):
    return tuple(Panel(lambda axes, k=k: draw(axes, f"line {k}"), **keys) for k in range(count))


@pytest.mark.parametrize("width", ["single", "double"])
def test_a_figure_has_the_width_of_a_column_and_letters_of_one_size(width):
    figure = drawn(FigureSpec("a", "", panels(3, title="x")), width)
    assert figure.get_size_inches()[0] * 25.4 == pytest.approx(COLUMN_MM[width])
    assert {axes.title.get_fontsize() for axes in figure.axes} == {8.0}
    assert [axes.get_title("left") for axes in figure.axes] == ["(a) x", "(b) x", "(c) x"]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("count", "keys", "width", "columns"),
    [
        (3, {}, "single", 1), (3, {}, "double", 3), (4, {}, "double", 2),
        (6, {"alike": True}, "single", 2), (2, {"stacked": True}, "double", 1),
    ],
)  # fmt: skip
def test_panels_are_side_by_side_if_there_is_room(count, keys, width, columns):
    figure = drawn(FigureSpec("a", "", panels(count), **keys), width)
    assert figure.axes[0].get_gridspec().ncols == columns


def test_panels_alike_are_named_at_the_edge_only():
    axes = drawn(FigureSpec("a", "", panels(3), alike=True)).axes
    assert [bool(each.get_xlabel()) for each in axes[:3]] == [False, True, True]
    assert [bool(each.get_ylabel()) for each in axes[:3]] == [True, False, True]
    assert axes[0].get_xlim() == axes[2].get_xlim()


def test_one_legend_names_everything_once_below_all_panels():
    figure = drawn(FigureSpec("a", "", (*panels(2), *panels(2))))
    assert [text.get_text() for text in figure.legends[0].get_texts()] == ["line 0", "line 1"]
    assert drawn(FigureSpec("a", "", panels(1))).legends == []


def test_no_legend_is_wider_than_its_figure():
    figure = drawn(FigureSpec("a", "", tuple(
        Panel(lambda axes, k=k: draw(axes, f"a rather long name of line {k}")) for k in range(9)
    )))  # fmt: skip
    figure.draw_without_rendering()
    box, whole = figure.legends[0].get_window_extent(), figure.bbox
    assert box.x0 >= 0.0
    assert box.x1 <= whole.x1


@pytest.fixture
def figure():
    return drawn(FigureSpec("a", "", (Panel(lambda axes: axes.plot([0, 1], [0, 1]), "x"),)))


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
        with pytest.raises(InputError, match="svg, pdf, png"):
            formats_of(wrong)
