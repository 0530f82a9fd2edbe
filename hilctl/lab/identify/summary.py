"""Text rows and lines about an identified or a refined model."""

from collections.abc import Sequence
from typing import TypeAlias

from hilctl.lab.identify.evaluation import Evaluation, LoopScore, StrokeError
from hilctl.lab.identify.fit_model import FittedModel
from hilctl.lab.identify.model_quality import Verdict, grade_of
from hilctl.lab.identify.pipeline import Identification
from hilctl.lab.identify.refinement import Refinement

Table: TypeAlias = tuple[tuple[str, ...], list[tuple[str, ...]]]
"""Headings, and rows of texts."""


def loop_table(errors: Sequence[LoopScore]) -> Table:
    """Return the errors of each loop."""
    return ("loop", "p-p µm", "peak %", "rms %", "area %"), [
        (
            *_row(error.label, error.peak_to_peak_um, error.peak_percent, error.rms_percent),
            "-" if error.area_error_percent is None else f"{error.area_error_percent:+.2f}",
        )
        for error in errors
    ]


def _row(label: str, *figures: float) -> tuple[str, ...]:
    return (label, *(f"{figure:.3g}" for figure in figures))


def parameter_texts(fit: FittedModel) -> list[tuple[str, str]]:
    """Return names and values, with standard errors if known, and marks at bounds."""
    return [(name, f"{value:.6g}" + _mark(fit, name)) for name, value in fit.parameters.items()]


def _mark(fit: FittedModel, name: str) -> str:
    if name in fit.at_bound:
        return " (at its bound)"
    sure = fit.standard_errors
    return f" ± {sure[name]:.2g}" if name in sure else ""


def summary(found: Identification) -> list[str]:
    """Return the result in a few lines, the grade first."""
    verdict = found.verdict
    return [str(verdict), verdict.largest, *verdict.notes, *details(found)]


def details(found: Identification) -> list[str]:
    """Return the lines of the summary below its verdict."""
    fit, held_out, known = found.fit, found.held_out, found.fit.model.provenance.identified_range
    spread = [start.rms_percent for start in fit.starts]
    ended = f"{fit.numbers} fitted parameters"
    if spread:
        ended = f"{len(spread)} starts ended at rms {min(spread):.3f} to {max(spread):.3f} %"
    lines = [*found.understood]
    if held_out is not None:
        lines.append(f"not fitted: {_errors(held_out.judgement)}; {held_out.how}")
    lines += [f"fitted: {_errors(fit)}", f"{ended}, in {fit.elapsed_s:.2f} s"]
    if known is not None:
        lines.append(
            f"identified for {_span(known.peak_to_peak_um)} µm peak-to-peak, "
            f"{_span(known.frequency_hz)} Hz, up to {known.speed_um_per_s:.4g} µm/s"
        )
    if found.lag_samples:
        lines.append(f"lag of the displacements: {found.lag_samples} samples")
    return lines


def _errors(judged: Evaluation) -> str:
    return (
        f"peak error {judged.peak_percent:.2f} %, rms {judged.rms_percent:.2f} % of the largest "
        f"peak-to-peak; {judged.own_peak_percent:.2f} % of a record's own"
    )


def _span(limits: tuple[float, float]) -> str:
    low, high = (f"{limit:.4g}" for limit in limits)
    return low if low == high else f"{low} to {high}"


def refinement_lines(found: Refinement) -> list[str]:
    """Return the comparison of both models, and the result of the identification."""
    lines = [str(found), *summary(found.identification)]
    if found.offsets_um:
        offsets = ", ".join(f"{offset_um:.3g}" for offset_um in found.offsets_um)
        lines.append(f"removed a constant displacement per run: {offsets} µm")
    return lines


def change_tables(found: Refinement) -> tuple[Table, Table]:
    """Return the errors before and after, of each record and of each class of strokes."""
    before, after = found.before, found.after
    return (
        _change_table("run", before.errors, after.errors),
        _change_table("stroke", before.classes, after.classes),
    )


def _change_table(
    what: str,
    before: Sequence[LoopScore | StrokeError],
    after: Sequence[LoopScore | StrokeError],
) -> Table:
    return (what, "peak % before", "after", "rms % before", "after"), [
        _row(was.label, was.peak_percent, now.peak_percent, was.rms_percent, now.rms_percent)
        for was, now in zip(before, after, strict=True)
    ]


def stroke_table(verdict: Verdict) -> Table:
    """Return the errors of each class of motions, the promised one and its grade first."""
    # Small errors are only usable if the data do not cover other motions.
    covered = verdict.held_out and verdict.grade in {"poor", grade_of(verdict.classes)}
    headings = "promised %", "grade", "median %", "rms %", "motions", "worst %", "worst motion"
    return ("stroke", *headings), [
        (
            *_row(each.label, each.peak_percent),
            grade_of([each], known=covered),
            f"{each.median_percent:.3g}",
            f"{each.rms_percent:.3g}",
            f"{each.motions}",
            f"{each.worst_percent:.3g}",
            each.worst,
        )
        for each in verdict.classes
    ]


def candidate_table(found: Identification) -> Table:
    """Return the kinds of model that were tried, with their errors on held-out data."""
    return ("tried", "mean by stroke %", "peak %", "rms %"), [
        (
            each.settings,
            *(
                f"{percent:.2f}"
                for percent in (each.stroke_percent, each.peak_percent, each.rms_percent)
            ),
        )
        for each in found.candidates
    ]
