"""An identified model, as rows and lines of text."""

from collections.abc import Sequence

from hilctl.identify.command import Identification
from hilctl.identify.fit_model import FittedModel
from hilctl.identify.judge import LoopError

HEADINGS = ("loop", "p-p um", "peak %", "rms %", "area %")


def error_rows(errors: Sequence[LoopError]) -> list[tuple[str, ...]]:
    """Return one row a loop under :data:`HEADINGS`."""
    rows = []
    for error in errors:
        area = "-" if error.area_error_percent is None else f"{error.area_error_percent:+.2f}"
        figures = (error.peak_to_peak_um, error.peak_percent, error.rms_percent)
        rows.append((error.label, *(f"{figure:.3g}" for figure in figures), area))
    return rows


def parameter_texts(fit: FittedModel) -> list[tuple[str, str]]:
    """Return names and values, with standard errors where there are any."""
    sure = fit.standard_errors
    return [
        (name, f"{value:.6g}" + (f" ± {sure[name]:.2g}" if name in sure else ""))
        for name, value in fit.parameters.items()
    ]


def summary(found: Identification) -> list[str]:
    """Return the result in a few lines."""
    fit, held_out = found.fit, found.held_out
    spread = [start.rms_percent for start in fit.starts]
    ended = f"{fit.numbers} numbers found"
    if spread:
        ended = f"{len(spread)} starts ended at rms {min(spread):.3f} to {max(spread):.3f} %"
    lines = [
        f"{ended}, in {fit.elapsed_s:.2f} s",
        f"peak error {fit.peak_percent:.2f} %, rms {fit.rms_percent:.2f} % of the largest "
        f"peak-to-peak; {fit.own_peak_percent:.2f} % of a loop's own",
    ]
    if held_out is not None:
        lines.append(
            f"not fitted: peak error {held_out.peak_percent:.2f} %, "
            f"rms {held_out.rms_percent:.2f} % of the largest peak-to-peak"
        )
    if found.lag_samples:
        lines.append(f"displacements taken {found.lag_samples} samples later than the commands")
    return lines
