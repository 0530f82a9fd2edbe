"""The identify command: settings together, progress shown, the model written and judged."""

import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

from hilctl.base.errors import InputError
from hilctl.identify.data import Record
from hilctl.identify.files import PUBLISHED_POINTS, load_records, write_model
from hilctl.identify.fit import Fit, Judgement, judge
from hilctl.identify.identify import identify
from hilctl.identify.model_size import OrderError, choose_lag, choose_order
from hilctl.identify.request import Request
from hilctl.identify.search import Progress as Tell
from hilctl.identify.settings import Settings
from hilctl.identify.workers import Map, workers


@dataclass(frozen=True, slots=True)
class Finding:
    """What was found, and how it does on data that it was not fitted to.

    Attributes:
        fit: The fit.
        data: What it was fitted to.
        held_out: Errors on other data; None where there were none.
        held_out_data: These data.
        orders: What each number of plays did on loops held out, where that was asked for.
        lag_samples: Samples by which tables' displacements were taken to lag.
    """

    fit: Fit
    data: Sequence[Record]
    held_out: Judgement | None
    held_out_data: Sequence[Record]
    orders: tuple[OrderError, ...]
    lag_samples: int

    def to_mapping(self) -> dict[str, Any]:
        """Return all figures as plain mappings, lists and numbers, for JSON."""
        return {
            **self.fit.to_mapping(),
            "held_out": None if self.held_out is None else asdict(self.held_out),
            "orders": [asdict(order) for order in self.orders],
            "lag_samples": self.lag_samples,
        }


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
    console = Console(stderr=True)
    columns = (TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn())
    hidden = quiet or not console.is_terminal
    with (
        workers(request.scheduler) as run,
        Progress(*columns, console=console, disable=hidden, transient=True) as bar,
    ):
        task = bar.add_task("identify", total=1.0)

        def tell(done: float, text: str) -> None:
            bar.update(task, completed=done, description=text)

        lag = _lag(paths, points, request, run, tell)
        records, unit = load_records(paths, points, request, lag)
        held_out, _ = load_records(validate, points, request, lag)
        settings, orders = _sized(request, records, request.settings(unit), run, tell)
        fit = _identified(request, records, settings, paths, run, tell)
    if output is not None:
        write_model(fit, output, overwrite=overwrite)
    judged = judge(fit.model, held_out, creep=settings.creep) if held_out else None
    return Finding(fit, records, judged, held_out, orders, lag)


def _lag(paths: Sequence[Path], points: int, request: Request, run: Map, tell: Tell) -> int:
    if request.lag_samples != "auto":
        return request.lag_samples
    _, unit = load_records(paths, points, request, 0)

    def load(lag: int) -> Sequence[Record]:
        return load_records(paths, points, request, lag)[0]

    return choose_lag(request.kind, load, request.settings(unit), run, tell)


def _sized(
    request: Request, records: Sequence[Record], settings: Settings, run: Map, tell: Tell
) -> tuple[Settings, tuple[OrderError, ...]]:
    if request.plays != "auto":
        return settings, ()
    return choose_order(request.kind, records, settings, run, tell)


def _identified(
    request: Request,
    records: Sequence[Record],
    settings: Settings,
    paths: Sequence[Path],
    run: Map,
    tell: Tell,
) -> Fit:
    return identify(
        request.kind,
        records,
        settings,
        np.random.default_rng(request.seed),
        time.perf_counter,
        source=[path.name for path in paths],
        created=datetime.now(UTC).isoformat(timespec="seconds"),
        progress=tell,
        run=run,
    )
