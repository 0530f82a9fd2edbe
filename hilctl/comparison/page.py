"""Table and figure as one self-contained page."""

import html
from pathlib import Path

from hilctl.analysis.html import document, grid, image, write_page
from hilctl.comparison.compare import Comparison
from hilctl.comparison.figure import comparison_figure
from hilctl.comparison.summary import headings, notes, table_rows, titles


def write_comparison(comparison: Comparison, path: Path) -> None:
    """Write the page; one of that name is replaced.

    Raises:
        InputError: It can't be written.
    """
    write_page(comparison_page(comparison), path)


def comparison_page(comparison: Comparison) -> str:
    """Return the page as HTML."""
    body = [
        "<h1>Models compared</h1>",
        f'<p class="file">{html.escape(", ".join(comparison.sources))}</p>',
        grid(headings(comparison), table_rows(comparison), "numbers"),
        *(f"<p>{html.escape(note)}</p>" for note in notes(comparison)),
        grid(("model", "what it is"), titles(comparison.rows)),
        image("Errors against frequency, and loops", comparison_figure(comparison)),
    ]
    return document("Models compared", body)
