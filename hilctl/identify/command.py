"""Identify from files: settings from texts, records in, the model written and judged."""

import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Protocol, TypeVar

from hilctl.base.errors import InputError
from hilctl.base.files import check_writable, write_text
from hilctl.base.types import CommandUnit
from hilctl.base.yaml import Document
from hilctl.identify.cross_validation import HeldOut, held_out_error
from hilctl.identify.data.data_files import load_records
from hilctl.identify.data.records import History, Record
from hilctl.identify.evaluation import Evaluation, judge
from hilctl.identify.fit_api import OnProgress, ignore_progress
from hilctl.identify.fit_model import FittedModel, error_table, fit_model
from hilctl.identify.model_quality import Verdict, verdict_of
from hilctl.identify.model_selection import CandidateScore, SelectedModel, choose_kind
from hilctl.identify.order_selection import OrderScore, choose_lag, choose_order
from hilctl.identify.parallel import MapFunction, serial_map, workers
from hilctl.identify.registry import entry
from hilctl.identify.resonances import WORTH, further_modes
from hilctl.identify.settings import FitSettings, IdentifySettings
from hilctl.models.base import HysteresisModel
from hilctl.models.linear_stages import FirstMode, FurtherMode
from hilctl.models.model_file import dump_model

TURNS = 4  # each finds a model anew


class Judged(Protocol):
    """A model, and how it does on data that its fit did not see."""

    @property
    def fit(self) -> FittedModel:
        """The model."""

    @property
    def held_out(self) -> HeldOut | None:
        """How it does on such data; None where there were none."""

    @property
    def settings(self) -> FitSettings:
        """How it was fitted."""


_Judged = TypeVar("_Judged", bound=Judged)


def with_modes(
    records: Sequence[Record], identify: Callable[[Sequence[FurtherMode]], _Judged]
) -> _Judged:
    """Return a model with the further modes that its records show.

    A mode that was left out bends all the rest, so the model is found anew without it each time,
    and what it leaves shows the modes the better.

    Args:
        records: What it is fitted to.
        identify: Finds a model of them, given modes that are known.
    """
    best = identify(())
    histories = [record for record in records if isinstance(record, History)]
    if not best.settings.looks_for("modes") or len(histories) < len(records):
        return best
    for _ in range(TURNS):
        model = best.fit.model
        structure, known = getattr(model, "structure", None), getattr(model, "modes", ())
        first_hz = structure.natural_hz if isinstance(structure, FirstMode) else None
        better = further_modes(histories, best.fit.modelled_um, known, first_hz)
        if better is None:
            break
        tried = identify(better)
        if not _rms_percent(tried) < WORTH * _rms_percent(best):
            break
        best = tried
    return best


def _rms_percent(judged: Judged) -> float:
    """Return the error on data held out; on all data where none were."""
    if judged.held_out is None:
        return judged.fit.rms_percent
    return judged.held_out.judgement.rms_percent


@dataclass(frozen=True, slots=True)
class Identification:
    """An identified model, and how it does on data that it was not fitted to.

    Attributes:
        fit: The fit.
        data: What it was fitted to.
        verdict: What the model is worth.
        held_out: Errors on data that the fit did not see; None where there were none.
        orders: What each number of plays did on loops held out, where that was asked for.
        lag_samples: Samples by which tables' displacements were taken to lag.
        candidates: How each kind did on data held out, where the best of them was asked for.
    """

    fit: FittedModel
    data: Sequence[Record]
    verdict: Verdict
    held_out: HeldOut | None
    orders: tuple[OrderScore, ...]
    lag_samples: int
    candidates: tuple[CandidateScore, ...] = ()

    def to_mapping(self) -> dict[str, Any]:
        """Return all figures as plain mappings, lists and numbers, for JSON."""
        return {
            "verdict": self.verdict.to_mapping(),
            "held_out": None if self.held_out is None else self.held_out.to_mapping(),
            **self.fit.to_mapping(),
            "orders": [asdict(order) for order in self.orders],
            "candidates": [asdict(candidate) for candidate in self.candidates],
            "lag_samples": self.lag_samples,
        }


def settings_from(kind: str, texts: Sequence[str]) -> IdentifySettings:
    """Return the choices of a fit, those of the kind changed by ``key=value`` texts.

    Args:
        kind: Kind of model; ``auto`` for the one that does best on data held out.
        texts: ``key=value``.

    Raises:
        InputError: There is no such kind, or a choice breaks a rule; all that do are listed.
    """
    if kind == "auto":
        document = Document("hilctl identify", "kind: field\nauto: true")
    else:
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
    """Fit a model to files, judge it on data that the fit did not see, and write it.

    What is not a model of these data is not written.

    Args:
        paths: Recordings and text tables.
        settings: The choices.
        output: Model file to write; None for none.
        validate: Files to judge the model on; where there are none, parts of the others.
        scheduler: Where independent fits run, see :func:`hilctl.identify.parallel.workers`.
        overwrite: Whether a model file of that name may be replaced.
        progress: Called with what is being done.

    Raises:
        InputError: A file or a setting can't be used; nothing is written.
    """
    if output is not None:
        check_writable(output, overwrite=overwrite, inputs=[*paths, *validate])
    with workers(scheduler) as run:
        lag = _lag(paths, settings, run, progress)
        records, recorded = load_records(paths, settings, lag)
        asked = settings.table.unit
        if recorded and asked and recorded != asked:
            raise InputError(f"--unit must be {recorded}, that of the recordings: {asked}")
        others, _ = load_records(validate, settings.model_copy(update={"leave_out": ()}), lag)
        source = [path.name for path in paths]
        unit = settings.unit(recorded)
        found = identify_records(records, settings, unit, others, source, run, progress)
    if output is not None and found.verdict.grade != "not a model":
        write_text(output, dump_model(found.fit.model), overwrite=overwrite)
    return replace(found, lag_samples=lag)


def identify_records(
    records: Sequence[Record],
    settings: FitSettings,
    unit: CommandUnit,
    validate: Sequence[Record] = (),
    source: Sequence[str] = (),
    run: MapFunction = serial_map,
    progress: OnProgress = ignore_progress,
) -> Identification:
    """Fit a model to records, and judge it on data that the fit did not see.

    Args:
        records: What it is fitted to.
        settings: The choices.
        unit: Unit of the command.
        validate: What it is judged on; where there is none, parts of ``records`` are left out of
            fits for that alone.
        source: Recordings or files that the data come from, for the provenance.
        run: Runs fits that do not depend on each other.
        progress: Called with what is being done.

    Raises:
        DataError: The data can't be used as asked, or there are none.
    """
    created = datetime.now(UTC).isoformat(timespec="seconds")

    def found(modes: Sequence[FurtherMode]) -> _Found:
        chosen, orders = settings, tuple[OrderScore, ...]()
        candidates = tuple[CandidateScore, ...]()
        held_out: HeldOut | None = None
        if isinstance(settings, IdentifySettings) and settings.auto:
            data = SelectedModel(tuple(records), settings, unit, tuple(modes))
            chosen, held_out, candidates = choose_kind(data, run, progress)
        elif settings.size == "auto":
            chosen, orders = choose_order(records, settings, run, progress)
        known = modes if chosen.looks_for("modes") else ()
        fit = fit_model(
            records, chosen, time.perf_counter, unit=unit, source=source, created=created,
            progress=progress, run=run, start=None if held_out is None else held_out.end,
            modes=known,
        )  # fmt: skip
        if held_out is None and not validate:
            held_out = held_out_error(records, chosen, unit, run, progress, modes=known)
        return _Found(fit, held_out, chosen, orders, candidates)

    best = with_modes(records, found)
    fit, held_out = best.fit, best.held_out
    if validate:
        others = judge(fit.model, validate, creep=settings.creep)
        held_out = HeldOut(others, tuple(validate), "files that were not fitted")
    verdict = verdict_of(fit, records, best.settings, held_out)
    if held_out is not None:
        fit = replace(fit, model=_with_held_out(fit.model, held_out.judgement))
    return Identification(fit, records, verdict, held_out, best.orders, 0, best.candidates)


@dataclass(frozen=True, slots=True)
class _Found:
    """A model with given modes, and how it was chosen."""

    fit: FittedModel
    held_out: HeldOut | None
    settings: FitSettings
    orders: tuple[OrderScore, ...]
    candidates: tuple[CandidateScore, ...]


def _with_held_out(model: HysteresisModel, judgement: Evaluation) -> HysteresisModel:
    """Return a model whose provenance says how it does on data that its fit did not see."""
    figures = {f"held_out_{name}": value for name, value in error_table(judgement).items()}
    errors = {**model.provenance.errors_percent, **figures}
    provenance = model.provenance.model_copy(update={"errors_percent": errors})
    return model.model_copy(update={"provenance": provenance})


def _lag(
    paths: Sequence[Path], settings: IdentifySettings, run: MapFunction, progress: OnProgress
) -> int:
    if not settings.table.find_lag:
        return settings.table.lag_samples

    def load(lag: int) -> Sequence[Record]:
        return load_records(paths, settings, lag)[0]

    return choose_lag(load, settings, run, progress)
