"""The identify command: settings together, progress shown, the result in a table."""

import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table

from hilctl.errors import InputError
from hilctl.identify.files import PUBLISHED_POINTS, TableOptions, load_records, write_model
from hilctl.identify.fit import Fit, Judgement, LoopError, judge
from hilctl.identify.fitting import identify
from hilctl.identify.settings import Kind, Layout, Settings, WeightBy, Weights
from hilctl.ports import CommandUnit

Value = TypeVar("Value")


@dataclass(frozen=True, slots=True)
class Request(TableOptions):
    """What the command line asked for; None stands for the published choice."""

    kind: Kind = "integrated"
    points: int | None = None
    seed: int = 1
    plays: int | None = None
    deadbands: int | None = None
    weights: Weights | None = None
    layout: Layout = "even"
    weight_by: WeightBy | None = None
    offset: bool = False
    starts: int | None = None
    peak_goal_percent: float | None = None
    unit: CommandUnit | None = None

    def settings(self, recorded: CommandUnit | None) -> Settings:
        """Return the choices of the fit, given the unit of the recordings.

        Raises:
            InputError: The unit is not known, or not what was recorded.
        """
        if recorded and self.unit and recorded != self.unit:
            raise InputError(f"--unit must be {recorded}, that of the recordings: {self.unit}")
        published = Settings.published(self.kind)
        return replace(
            published,
            plays=_given(self.plays, published.plays),
            deadbands_a_side=_given(self.deadbands, published.deadbands_a_side),
            weights=_given(self.weights, published.weights),
            layout=self.layout,
            weight_by=_given(self.weight_by, published.weight_by),
            output_offset=self.offset,
            starts=_given(self.starts, published.starts),
            peak_goal_percent=self.peak_goal_percent,
            input_unit=_given(recorded or self.unit, published.input_unit),
        )


def _given(asked: Value | None, published: Value) -> Value:
    return published if asked is None else asked


@dataclass(frozen=True, slots=True)
class Finding:
    """What was found, and how it does on data that it was not fitted to."""

    fit: Fit
    held_out: Judgement | None

    def to_mapping(self) -> dict[str, Any]:
        """Return all of it as plain mappings, lists and numbers, for JSON."""
        held_out = None if self.held_out is None else asdict(self.held_out)
        return {**self.fit.to_mapping(), "held_out": held_out}


def find(
    paths: Sequence[Path],
    request: Request,
    output: Path | None,
    *,
    validate: Sequence[Path] = (),
    overwrite: bool,
    quiet: bool,
) -> Finding:
    """Fit a model to files, write it, and judge it on other files.

    Raises:
        InputError: A file or a setting can't be used; nothing is written.
    """
    if output is not None and output.exists() and not overwrite:
        raise InputError(f"{output}: exists already: give another --output, or --overwrite")
    points = request.points or PUBLISHED_POINTS[request.kind]
    records, recorded_unit = load_records(paths, points, request)
    settings = request.settings(recorded_unit)
    held_out, _ = load_records(validate, points, request)
    console = Console(stderr=True)
    columns = (TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn())
    hidden = quiet or not console.is_terminal
    with Progress(*columns, console=console, disable=hidden, transient=True) as bar:
        task = bar.add_task("identify", total=1.0)
        fit = identify(
            request.kind,
            records,
            settings,
            np.random.default_rng(request.seed),
            time.perf_counter,
            source=[path.name for path in paths],
            created=datetime.now(UTC).isoformat(timespec="seconds"),
            progress=lambda done, text: bar.update(task, completed=done, description=text),
        )
    if output is not None:
        write_model(fit, output, overwrite=overwrite)
    return Finding(fit, judge(fit.model, held_out) if held_out else None)


def _errors_table(title: str, errors: Sequence[LoopError]) -> Table:
    table = Table(title=title)
    for name in ("loop", "p-p um", "peak %", "rms %", "area %"):
        table.add_column(name, justify="left" if name == "loop" else "right")
    for error in errors:
        area = "-" if error.area_error_percent is None else f"{error.area_error_percent:+.2f}"
        figures = (error.peak_to_peak_um, error.peak_percent, error.rms_percent)
        table.add_row(error.label, *(f"{figure:.3g}" for figure in figures), area)
    return table


def print_finding(finding: Finding, output: Path | None) -> None:
    """Print errors loop by loop, parameters, and where the model went."""
    console = Console()
    fit, held_out = finding.fit, finding.held_out
    console.print(_errors_table(fit.model.provenance.method, fit.errors))
    if held_out is not None:
        console.print(_errors_table("not fitted, to check the model", held_out.errors))
    rows = ", ".join(f"{name} {value:.6g}" for name, value in fit.parameters.items())
    console.print(f"parameters: {rows}", highlight=False)
    spread = [start.rms_percent for start in fit.starts]
    console.print(
        f"{len(spread)} starts ended at rms {min(spread):.3f} to {max(spread):.3f} %, "
        f"in {fit.elapsed_s:.1f} s",
        highlight=False,
    )
    console.print(
        f"[bold]peak error {fit.peak_percent:.2f} %, rms {fit.rms_percent:.2f} %[/] of the largest "
        f"peak-to-peak; {fit.own_peak_percent:.2f} % of a loop's own",
        highlight=False,
    )
    if held_out is not None:
        console.print(
            f"not fitted: peak error {held_out.peak_percent:.2f} %, "
            f"rms {held_out.rms_percent:.2f} % of the largest peak-to-peak",
            highlight=False,
        )
    if output is not None:
        console.print(f"model: {output}", soft_wrap=True, highlight=False)
