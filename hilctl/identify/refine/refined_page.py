"""A refined model as rows, and as one self-contained page: before and after, run by run."""

import html
from pathlib import Path

from hilctl.analysis.html import document, grid, wide_figure, write_page
from hilctl.identify.model_page import loops_figure
from hilctl.identify.refine.refinement import Refinement
from hilctl.models.model_file import dump_model

HEADINGS = ("run", "p-p µm", "peak % before", "after", "rms % before", "after")
MOST_RUNS = 12


def refinement_rows(found: Refinement) -> list[tuple[str, ...]]:
    """Return one row a run that was held out, under :data:`HEADINGS`."""
    before, after = (held.judgement.errors for held in (found.choice.before, found.choice.after))
    return [
        (
            was.label,
            *(
                f"{figure:.3g}"
                for figure in (
                    was.peak_to_peak_um,
                    was.peak_percent,
                    now.peak_percent,
                    was.rms_percent,
                    now.rms_percent,
                )
            ),
        )
        for was, now in zip(before, after, strict=True)
    ]


def write_refinement(found: Refinement, path: Path) -> None:
    """Write the page; one of that name is replaced.

    Raises:
        InputError: It can't be written.
    """
    write_page(refinement_page(found), path)


def refinement_page(found: Refinement) -> str:
    """Return the page as HTML."""
    after = found.choice.after
    shown = after.records[:MOST_RUNS]
    title = html.escape(f"Refined: {', '.join(found.model.provenance.source)}")
    body = [
        f"<h1>{title}</h1>",
        f"<p>{html.escape(str(found))}</p>",
        f"<p>{html.escape(after.how)}</p>",
        "<h2>Errors on runs not fitted</h2>",
        grid(HEADINGS, refinement_rows(found), "numbers"),
    ]
    for heading, held in (("Before", found.choice.before), ("After", after)):
        modelled = held.judgement.modelled_um[:MOST_RUNS]
        figure = loops_figure(modelled, shown, found.model.input_unit)
        body += [f"<h2>{heading}</h2>", wide_figure(heading, figure)]
    body += [f"<details><summary>Model</summary><pre>{html.escape(dump_model(found.model))}</pre>"]
    return document(title, [*body, "</details>"])
