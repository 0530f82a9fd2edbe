"""A page of before and after that needs nothing else."""

import pytest

from hilctl.identify.refine.refined_page import (
    HEADINGS,
    refinement_page,
    refinement_rows,
    write_refinement,
)
from hilctl.identify.refine.refinement import refine_runs


@pytest.mark.slow
@pytest.mark.usefixtures("undrawn")
def test_page_has_verdict_table_figures_and_model(old, runs, tmp_path):
    found = refine_runs(old, runs[:3], source="a<b>.yaml")
    rows = refinement_rows(found)
    assert [row[0] for row in rows] == ["run 0", "run 1", "run 2"]
    assert all(len(row) == len(HEADINGS) for row in rows)
    page = refinement_page(found)
    assert "a&lt;b&gt;.yaml" in page
    assert "<b>" not in page.replace("<body>", "")
    assert page.count("<svg") == 2
    assert "kind: refined" in page
    write_refinement(found, tmp_path / "page.html")
    assert (tmp_path / "page.html").read_text() == page
