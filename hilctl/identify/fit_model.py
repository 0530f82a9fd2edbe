"""Fit of a model to records: the model, its errors, its provenance and its identified range."""

import time
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
import scipy
from scipy.fft import rfft, rfftfreq

import hilctl
from hilctl.experiment.model_validity import ALL, spectrum
from hilctl.identify.creep_fit import creep_of, without_creep
from hilctl.identify.data.records import History, Record, SteadyLoop, thinned, turning_points
from hilctl.identify.evaluation import Evaluation, judge
from hilctl.identify.fit_api import FitData, FitJob, FitRequest, FoundModel
from hilctl.identify.registry import CATALOGUE
from hilctl.identify.resonances import without_modes
from hilctl.models.base import IdentifiedRange, Provenance

EVERY_SAMPLE = {"staged", "field", "generalised_duhem"}
"""Kinds with a lag: for the others, long records are thinned."""


def fit_kind(request: FitRequest) -> FoundModel:
    """Fit a kind of model to records without creep and known modes, which become its parts."""
    records, settings, unit = request.records, request.settings, request.unit
    modes = request.modes if settings.looks_for("modes") else ()
    creep = creep_of(records) if settings.looks_for("creep_stage") else None
    bare = records if creep is None else without_creep(records, creep)
    bare = without_modes(bare, modes) if modes else bare
    data = FitData(bare if settings.kind in EVERY_SAMPLE else thinned(bare), unit)
    job = FitJob(data, settings, request.run, request.progress, request.start)
    found = CATALOGUE[settings.kind].fit(job)
    known, parameters, numbers = dict[str, Any](), dict(found.parameters), found.numbers
    if creep is not None:
        known["creep"] = creep
        parameters["creep_share"] = sum(creep.shares)
        numbers += len(creep.shares)
    for k, mode in enumerate(modes, start=2):
        known["modes"] = tuple(modes)
        parameters |= {f"{name}_{k}": value for name, value in mode.model_dump().items()}
        numbers += len(type(mode).model_fields)
    if not known:
        return found
    known["output_range_um"] = FitData(records, unit).output_range_um
    model = found.model.model_copy(update=known)
    return replace(found, model=model, numbers=numbers, parameters=parameters)


SMALL, FEWEST_SWINGS = 0.1, 10
NOT_ZERO_UM = 1e-6
LEAST = 0.01  # part of a history's power below its lowest frequency


def identified_range(data: FitData) -> IdentifiedRange:
    """Return the range of motions, frequencies and speeds of the records."""
    moves = [float(np.ptp(data.target_um[place])) for place in data.places]
    speeds = [
        move * float(speed.max()) / float(np.ptp(record.command))
        for move, speed, record in zip(moves, data.speeds, data.records, strict=True)
    ]
    lowest, highest = zip(*map(frequencies_hz, data.records), strict=True)
    return IdentifiedRange(
        peak_to_peak_um=(min(map(smallest_um, data.records)), max(moves)),
        frequency_hz=(min(lowest), max(highest)),
        speed_um_per_s=max(speeds),
    )


def smallest_um(record: Record) -> float:
    """Return the peak-to-peak of a loop, or of a history's smaller swings."""
    # A tenth of the path is in smaller ones: noise, and the end of decaying cycles.
    if isinstance(record, History):
        at = turning_points(record.command)
        swings_um = np.sort(np.abs(np.diff(record.displacement_um[at])))
        if swings_um.size >= FEWEST_SWINGS:
            way_um = np.cumsum(swings_um)
            found = float(swings_um[np.searchsorted(way_um, SMALL * way_um[-1])])
            return max(found, NOT_ZERO_UM)
    return float(np.ptp(record.displacement_um))


def frequencies_hz(record: Record) -> tuple[float, float]:
    """Return the lowest and the highest frequency of a record's command."""
    command = record.command
    power = np.cumsum(np.abs(rfft(command - command.mean())) ** 2)
    if isinstance(record, SteadyLoop):
        harmonics = max(int(np.searchsorted(power, ALL * power[-1])), 1)
        return record.frequency_hz, record.frequency_hz * harmonics
    first = int(np.searchsorted(power, LEAST * power[-1]))
    lowest = float(rfftfreq(command.size, 1.0 / record.sample_rate_hz)[max(first, 1)])
    return lowest, max(lowest, spectrum(command, record.sample_rate_hz).highest_hz)


VERSIONS = {"hilctl": hilctl.__version__, "numpy": np.__version__, "scipy": scipy.__version__}


@dataclass(frozen=True, kw_only=True)
class FittedModel(Evaluation, FoundModel):
    """An identified model with its provenance, and its errors on the fitted records."""

    elapsed_s: float

    def to_mapping(self) -> dict[str, Any]:
        """Return all fields as plain mappings, lists and numbers, for JSON."""
        return {
            "model": {"kind": getattr(self.model, "kind"), **self.model.to_mapping()},  # noqa: B009
            **Evaluation.to_mapping(self),
            "starts": [asdict(start) for start in self.starts],
            "numbers": self.numbers,
            "parameters": self.parameters,
            "standard_errors": self.standard_errors,
            "at_bound": list(self.at_bound),
            "elapsed_s": self.elapsed_s,
        }


def fit_model(request: FitRequest) -> FittedModel:
    """Fit a model's parameters to steady loops and time histories.

    The criterion is the published sum of squared displacement errors (4.9, 5.14, 6.24) over all
    points of all loops, subject to the published bounds and to the conditions for the inverse.

    The linear algebra is many small steps: with more than one BLAS thread on a busy machine they
    take up to 30 times as long, so programs set ``OPENBLAS_NUM_THREADS=1`` before NumPy loads.

    Raises:
        DataError: The data can't be used as asked, or there are none.
    """
    begin, settings = time.perf_counter(), request.settings
    data = FitData(request.records, request.unit)
    found = fit_kind(request)
    judged = judge(found.model, data, creep=settings.creep)
    provenance = Provenance(
        source=tuple(request.source),
        method="; ".join(filter(None, (CATALOGUE[settings.kind].title, settings.changes()))),
        grid=tuple(map(_grid_line, request.records)),
        parameters=found.parameters,
        errors_percent=error_table(judged),
        identified_range=identified_range(data),
        versions=VERSIONS,
    )
    request.progress(1.0, "done")
    model = found.model.model_copy(update={"provenance": provenance})
    known = vars(judged) | vars(found) | {"model": model, "end": None}
    return FittedModel(**known, elapsed_s=time.perf_counter() - begin)


def _grid_line(record: Record) -> str:
    """Return a one-line description of a record."""
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
