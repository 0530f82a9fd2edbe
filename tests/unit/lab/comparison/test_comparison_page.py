"""The page of a comparison: its table, its figure, and that an existing page is kept."""

from pathlib import Path

import pytest

from hilctl.base.errors import InputError
from hilctl.cli.models import compare as command
from hilctl.lab.comparison.comparison_page import comparison_page, comparison_sheets
from hilctl.lab.pages.figure_layout import drawn


@pytest.mark.slow
def test_the_page_holds_table_and_figure(comparison):
    page = comparison_page(comparison)
    assert page.count("<svg") == 4
    assert "http://" not in page
    assert "https://" not in page
    for row in comparison.rows:
        assert row.name in page


def test_each_model_has_one_colour_in_all_figures(comparison):
    errors, *loops = (drawn(sheet) for sheet in comparison_sheets(comparison))
    colours = [[line.get_color() for line in axes.lines] for axes in errors.axes]
    assert colours[0] == colours[1] == [figure.axes[0].lines[1].get_color() for figure in loops]
    assert len(set(colours[0])) == len(comparison.rows)


def test_an_existing_page_is_kept(tmp_path):
    page = tmp_path / "models.html"
    page.write_text("mine")
    with pytest.raises(InputError, match="overwrite"):
        command([Path("nowhere.mcap")], html=page)
    assert page.read_text() == "mine"
