"""Fit a model: measured data in, model and its errors out."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import scipy

import hilctl
from hilctl.base.types import CommandUnit
from hilctl.identify.data.records import Record, Records, SteadyLoop
from hilctl.identify.evaluation import Evaluation, judge
from hilctl.identify.fit_api import OnProgress, StartOutcome, ignore_progress
from hilctl.identify.fit_data import FitData
from hilctl.identify.fit_kind import fit_kind
from hilctl.identify.identified_range import identified_range
from hilctl.identify.parallel import MapFunction, serial_map
from hilctl.identify.registry import CATALOGUE
from hilctl.identify.settings import FitSettings
from hilctl.models.base import HysteresisModel, Provenance
from hilctl.models.linear_stages import FurtherMode

VERSIONS = {"hilctl": hilctl.__version__, "numpy": np.__version__, "scipy": scipy.__version__}


@dataclass(frozen=True, slots=True, kw_only=True)
class FittedModel(Evaluation):
    """An identified model, and how far it is from what it was fitted to.

    Attributes:
        model: The model, with its provenance.
        numbers: How many numbers were found for it.
        starts: What became of each start of the search.
        parameters: Fitted parameters under their published names, in command units, um and s.
        standard_errors: Of the parameters, by the same names; empty where a fit has none.
        at_bound: Parameters that stand on a bound: not found, but as far as they may go.
        elapsed_s: How long it took.
    """

    model: HysteresisModel
    numbers: int
    starts: tuple[StartOutcome, ...]
    parameters: Mapping[str, float]
    standard_errors: Mapping[str, float]
    at_bound: tuple[str, ...]
    elapsed_s: float

    def to_mapping(self) -> dict[str, Any]:
        """Return all of it as plain mappings, lists and numbers, for JSON."""
        return {
            "model": {"kind": getattr(self.model, "kind"), **self.model.to_mapping()},  # noqa: B009
            **Evaluation.to_mapping(self),
            "starts": [asdict(start) for start in self.starts],
            "numbers": self.numbers,
            "parameters": dict(self.parameters),
            "standard_errors": dict(self.standard_errors),
            "at_bound": list(self.at_bound),
            "elapsed_s": self.elapsed_s,
        }


def fit_model(
    records: Records,
    settings: FitSettings,
    clock: Callable[[], float],
    *,
    unit: CommandUnit = "A",
    source: Sequence[str] = (),
    created: str = "",
    progress: OnProgress = ignore_progress,
    run: MapFunction = serial_map,
    start: object | None = None,
    modes: Sequence[FurtherMode] = (),
) -> FittedModel:
    """Fit a model's parameters to steady loops and time histories.

    The criterion is the published sum of squared displacement errors (4.9, 5.14, 6.24) over all
    points of all loops, subject to the published bounds and to the conditions for the inverse.

    The linear algebra is many small steps: with more than one BLAS thread on a busy machine they
    take up to 30 times as long, so programs set ``OPENBLAS_NUM_THREADS=1`` before NumPy loads.

    Args:
        records: At least one loop or history; steady loops only for what has dynamics.
        settings: The kind of model, and all other choices.
        clock: Time in s, for ``elapsed_s``.
        unit: Unit of the command.
        source: Recordings or files that the data come from, for the provenance.
        created: Date and time in ISO 8601, UTC, for the provenance.
        progress: Called with what is being done.
        run: Follows starts that do not depend on each other.
        start: Where the search begins, see :class:`~hilctl.identify.fit_api.FitJob`.
        modes: Further modes of the structure, for kinds that have them.

    Raises:
        DataError: The data can't be used as asked, or there are none.
    """
    begin = clock()
    data = FitData(records, unit)
    found = fit_kind(records, settings, unit, run=run, progress=progress, start=start, modes=modes)
    judged = judge(found.model, data, creep=settings.creep)
    provenance = Provenance(
        source=tuple(source),
        method=_method(settings),
        grid=tuple(map(_grid_line, records)),
        parameters=found.parameters,
        errors_percent=error_table(judged),
        identified_range=identified_range(data),
        versions=VERSIONS,
        created=created,
    )
    progress(1.0, "done")
    return FittedModel(
        errors=judged.errors,
        modelled_um=judged.modelled_um,
        peak_percent=judged.peak_percent,
        rms_percent=judged.rms_percent,
        own_peak_percent=judged.own_peak_percent,
        model=found.model.model_copy(update={"provenance": provenance}),
        numbers=found.numbers,
        starts=found.starts,
        parameters=found.parameters,
        standard_errors=found.standard_errors,
        at_bound=found.at_bound,
        elapsed_s=clock() - begin,
    )


def _method(settings: FitSettings) -> str:
    """Return the kind of model, and what was not left as published, in one line."""
    title = CATALOGUE[settings.kind].title
    changes = settings.changes()
    return f"{title}; {changes}" if changes else title


def _grid_line(record: Record) -> str:
    """Return what one record holds in one line."""
    command = record.command
    low, high = float(command.min()), float(command.max())
    if isinstance(record, SteadyLoop):
        points = f"{command.size} points at {record.frequency_hz:g} Hz"
    else:
        points = f"{command.size} samples at {record.sample_rate_hz:g} Hz"
        points += f", first {record.ignore} ignored"
    return f"{record.label}: {low:.4g} to {high:.4g}, {points}"


def error_table(judged: Evaluation) -> dict[str, float]:
    """Return the errors by name."""
    areas = [error.area_error_percent for error in judged.errors]
    table = {
        "peak": judged.peak_percent,
        "rms": judged.rms_percent,
        "own_peak": judged.own_peak_percent,
    }
    known = [abs(area) for area in areas if area is not None]
    return table | ({"area": max(known)} if known else {})
