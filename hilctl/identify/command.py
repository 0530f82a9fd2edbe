"""Identify from files: settings from texts, records in, the model written and judged."""

import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from hilctl.base.errors import InputError
from hilctl.base.files import check_writable, write_text
from hilctl.base.yaml.document import Document
from hilctl.identify.catalogue import entry
from hilctl.identify.data.files import load_records
from hilctl.identify.data.records import Record
from hilctl.identify.fit_model import FittedModel, fit_model
from hilctl.identify.job import OnProgress, ignore_progress
from hilctl.identify.judge import Judgement, judge
from hilctl.identify.model_size import OrderError, choose_lag, choose_order
from hilctl.identify.settings import FitSettings, IdentifySettings
from hilctl.identify.workers import Map, workers
from hilctl.models.files import dump_model


@dataclass(frozen=True, slots=True)
class Identification:
    """An identified model, and how it does on data that it was not fitted to.

    Attributes:
        fit: The fit.
        data: What it was fitted to.
        held_out: Errors on other data; None where there were none.
        held_out_data: These data.
        orders: What each number of plays did on loops held out, where that was asked for.
        lag_samples: Samples by which tables' displacements were taken to lag.
    """

    fit: FittedModel
    data: Sequence[Record]
    held_out: Judgement | None
    held_out_data: Sequence[Record]
    orders: tuple[OrderError, ...]
    lag_samples: int

    def to_mapping(self) -> dict[str, Any]:
        """Return all figures as plain mappings, lists and numbers, for JSON."""
        return {
            **self.fit.to_mapping(),
            "held_out": None if self.held_out is None else self.held_out.to_mapping(),
            "orders": [asdict(order) for order in self.orders],
            "lag_samples": self.lag_samples,
        }


def settings_from(kind: str, texts: Sequence[str]) -> IdentifySettings:
    """Return the choices of a fit, those of the kind changed by ``key=value`` texts.

    Raises:
        InputError: There is no such kind, or a choice breaks a rule; all that do are listed.
    """
    known, _ = entry(kind)
    document = Document("hilctl identify", f"kind: {known}")
    for text in texts:
        document.set(text)
    return document.validate(IdentifySettings)


def identify_files(
    paths: Sequence[Path],
    settings: IdentifySettings,
    output: Path | None,
    validate: Sequence[Path] = (),
    scheduler: str = "none",
    *,
    overwrite: bool = False,
    progress: OnProgress = ignore_progress,
) -> Identification:
    """Fit a model to files, write it, and judge it on other files.

    Args:
        paths: Recordings and text tables.
        settings: The choices.
        output: Model file to write; None for none.
        validate: Files to judge the model on.
        scheduler: Where independent fits run, see :func:`hilctl.identify.workers.workers`.
        overwrite: Whether a model file of that name may be replaced.
        progress: Called with what is being done.

    Raises:
        InputError: A file or a setting can't be used; nothing is written.
    """
    if output is not None:
        check_writable(output, overwrite=overwrite)
    with workers(scheduler) as run:
        lag = _lag(paths, settings, run, progress)
        records, recorded = load_records(paths, settings, lag)
        asked = settings.table.unit
        if recorded and asked and recorded != asked:
            raise InputError(f"--unit must be {recorded}, that of the recordings: {asked}")
        held_out, _ = load_records(validate, settings, lag)
        chosen: FitSettings = settings
        orders: tuple[OrderError, ...] = ()
        if settings.size == "auto":
            chosen, orders = choose_order(records, settings, run, progress)
        fit = fit_model(
            records,
            chosen,
            time.perf_counter,
            unit=settings.unit(recorded),
            source=[path.name for path in paths],
            created=datetime.now(UTC).isoformat(timespec="seconds"),
            progress=progress,
            run=run,
        )
    if output is not None:
        write_text(output, dump_model(fit.model), overwrite=overwrite)
    judged = judge(fit.model, held_out, creep=settings.creep) if held_out else None
    return Identification(fit, records, judged, held_out, orders, lag)


def _lag(paths: Sequence[Path], settings: IdentifySettings, run: Map, progress: OnProgress) -> int:
    if not settings.table.find_lag:
        return settings.table.lag_samples

    def load(lag: int) -> Sequence[Record]:
        return load_records(paths, settings, lag)[0]

    return choose_lag(load, settings, run, progress)
