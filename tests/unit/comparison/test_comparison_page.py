"""The page of a comparison: its table, its figure, and that an existing page is kept."""

from pathlib import Path

import pytest

from hilctl.base.errors import InputError
from hilctl.cli.models import compare as command
from hilctl.comparison.comparison_page import comparison_figure, comparison_page


@pytest.mark.slow
def test_the_page_holds_table_and_figure(comparison):
    page = comparison_page(comparison)
    assert page.count("<svg") == 1
    assert "http://" not in page
    assert "https://" not in page
    for row in comparison.rows:
        assert row.name in page


def test_the_figure_draws_each_model_once(comparison):
    upper, lower = comparison_figure(comparison).subfigs
    assert [len(axes.lines) for axes in upper.axes] == [3, 3]
    assert sum(bool(axes.lines) for axes in lower.axes) == 3


def test_an_existing_page_is_kept(tmp_path):
    page = tmp_path / "models.html"
    page.write_text("mine")
    with pytest.raises(InputError, match="--overwrite"):
        command([Path("nowhere.mcap")], html=page)
    assert page.read_text() == "mine"
