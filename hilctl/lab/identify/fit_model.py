"""Fit of a model to records: the model, its errors, its provenance and its identified range.

Creep is identified first and removed from the records, and models are fitted to the rest.
"""

import math
import time
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
import scipy
from pydantic import ValidationError
from scipy.fft import rfft, rfftfreq

import hilctl
from hilctl.base.errors import DataError
from hilctl.experiment.model_validity import ALL, QUIET, spectrum
from hilctl.lab.identify.creep_spectrum import creep_of, without_creep, without_fastest
from hilctl.lab.identify.data.records import (
    History,
    Record,
    SteadyLoop,
    thinned,
    turning_points,
)
from hilctl.lab.identify.evaluation import Evaluation, judge
from hilctl.lab.identify.fit_api import FitJob, FitRequest, FoundModel
from hilctl.lab.identify.fit_data import FitData
from hilctl.lab.identify.resonances import without_modes
from hilctl.models.base import HysteresisModel, IdentifiedRange, Provenance
from hilctl.models.linear_stages import CreepModel
from hilctl.models.staged import StagedModel

FASTEST = 0.95  # error with the fastest elements of creep, over the one without, if they are kept
_HELD_S, _HELD_RATE_HZ = 0.1, 10e3  # commands held; rate for records of unknown sample rate


def fit_kind(request: FitRequest) -> FoundModel:
    """Fit a kind of model to records without creep and known modes, which become its parts."""
    settings = request.settings
    linear = settings.looks_for("creep_stage") and not settings.looks_for("activation")
    creep = creep_of(request.records) if linear else None
    found = _fit_with(request, creep)
    slow = None if creep is None else without_fastest(creep)
    if slow is None or slow == creep:
        return found
    # Rests hardly show the fastest elements, and motions also show losses.
    other = _fit_with(request, slow)
    errors = [judge(each.model, request.records).stroke_percent for each in (found, other)]
    return found if errors[0] < FASTEST * errors[1] else other


def _fit_with(request: FitRequest, creep: CreepModel | None) -> FoundModel:
    """Fit a kind of model with known creep."""
    records, settings, unit = request.records, request.settings, request.unit
    modes = request.modes if settings.looks_for("modes") else ()
    bare = records if creep is None else without_creep(records, creep)
    bare = without_modes(bare, modes) if modes else bare
    data = FitData(bare if settings.fit.has_lag else thinned(bare), unit)
    structure = settings.looks_for("structure") and (request.structure or True)
    job = FitJob(data, settings, request.run, request.progress, request.start, structure)
    try:
        found = settings.fit.fit(job)
    except ValidationError as error:
        rule = f"the best fit of --model {settings.kind} is not a valid model"
        cure = "choose another kind, or remove faulty samples (steps, spikes, drift) from the data"
        raise DataError(f"{rule} ({error.errors()[0]['msg']}): {cure}") from None
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
    model = found.model.model_copy(update=known)
    return replace(found, model=model, numbers=numbers, parameters=parameters)


SMALL, FEWEST_SWINGS = 0.1, 10
NOT_ZERO_UM = 1e-6
LEAST = 0.01  # part of a history's power below its lowest frequency


def identified_range(data: FitData, highest_hz: float | None = None) -> IdentifiedRange:
    """Return the range of motions, frequencies and speeds of the records.

    Frequencies above ``highest_hz`` are not evaluated, so they are outside of it.
    """
    moves = [float(np.ptp(data.target_um[place])) for place in data.places]
    speeds = [
        move * float(np.abs(record.rate()).max()) / float(np.ptp(record.command))
        for move, record in zip(moves, data.records, strict=True)
    ]
    lowest, highest = zip(*map(frequencies_hz, data.records), strict=True)
    return IdentifiedRange(
        peak_to_peak_um=(min(map(smallest_um, data.records)), max(moves)),
        frequency_hz=(min(lowest), min(max(highest), max(highest_hz or math.inf, min(lowest)))),
        speed_um_per_s=max(speeds),
    )


def smallest_um(record: Record) -> float:
    """Return the peak-to-peak of a loop, or of a history's smaller swings."""
    # A tenth of the path is in smaller ones: noise, and the end of decaying cycles.
    displacement_um = record.displacement_um
    if isinstance(record, History):
        at = record.ignore + turning_points(record.command[record.ignore :])
        swings_um = np.sort(np.abs(np.diff(displacement_um[at])))
        displacement_um = displacement_um[record.evaluated()]
        if swings_um.size >= FEWEST_SWINGS:
            way_um = np.cumsum(swings_um)
            found = float(swings_um[np.searchsorted(way_um, SMALL * way_um[-1])])
            return max(found, NOT_ZERO_UM)
    return float(np.ptp(displacement_um))


def frequencies_hz(record: Record) -> tuple[float, float]:
    """Return the lowest and the highest frequency of a record's command."""
    command = record.command
    power = np.cumsum(np.abs(rfft(command - command.mean())) ** 2)
    if isinstance(record, SteadyLoop):
        harmonics = max(int(np.searchsorted(power, ALL * power[-1])), 1)
        return record.frequency_hz, record.frequency_hz * harmonics
    first = int(np.searchsorted(power, LEAST * power[-1]))
    lowest = float(rfftfreq(command.size, 1.0 / record.sample_rate_hz)[max(first, 1)])
    quiet = QUIET * float(np.ptp(command))
    rate_hz = record.sample_rate_hz
    main_hz = spectrum(command, rate_hz, lowest, quiet).main_hz
    # The end of a sweep is resolved by windows that are not longer than its fast motions need.
    return lowest, max(lowest, spectrum(command, rate_hz, max(lowest, main_hz), quiet).highest_hz)


VERSIONS = {"hilctl": hilctl.__version__, "numpy": np.__version__, "scipy": scipy.__version__}


@dataclass(frozen=True, kw_only=True)
class FittedModel(Evaluation, FoundModel):
    """An identified model with its provenance, and its errors on the fitted records."""

    elapsed_s: float

    def to_mapping(self) -> dict[str, Any]:
        """Return all fields as plain mappings, lists and numbers, for JSON."""
        return {
            "model": self.model.to_mapping(),
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
    Raise DataError if the data do not suit the settings, or there are none.
    """
    begin, settings = time.perf_counter(), request.settings
    data = FitData(request.records, request.unit)
    found = fit_kind(request)
    judged = judge(found.model, data, creep=settings.creep, highest_hz=settings.highest_hz)
    if not judged.classes:
        slowest_hz = min(frequencies_hz(record)[0] for record in request.records)
        raise DataError(
            f"no motion is as slow as highest_hz={settings.highest_hz:g}: set it above the lowest "
            f"frequency of the data, {slowest_hz:.3g} Hz"
        )
    provenance = Provenance(
        source=tuple(request.source),
        method="; ".join(filter(None, (settings.fit.title, settings.changes()))),
        grid=tuple(map(_grid_line, request.records)),
        parameters=found.parameters,
        errors_percent=error_table(judged),
        identified_range=identified_range(data, settings.highest_hz),
        versions=VERSIONS,
    )
    request.progress(1.0, "done")
    update = {"provenance": provenance, "output_range_um": _range_um(found.model, data)}
    model = found.model.model_copy(update=update)
    known = vars(judged) | vars(found) | {"model": model, "end": None}
    return FittedModel(**known, elapsed_s=time.perf_counter() - begin)


def _range_um(model: HysteresisModel, data: FitData) -> tuple[float, float] | None:
    """Return the displacements of the records that steady commands reach again and again.

    Fast loops excite the structure, so they may reach far beyond those of a slow reference, and a
    drive of one sign does not return to its first rest.
    """
    if not isinstance(model, StagedModel):
        return model.output_range_um
    rate_hz = 0.5 / data.half_period_s if data.half_period_s else _HELD_RATE_HZ
    low, high = data.input_range
    held = np.repeat((high, low, high), max(round(_HELD_S * rate_hz), 1))
    rigid = model.model_copy(update={"structure": None, "modes": ()})  # nothing rings at the steps
    held_um = rigid.forward(rate_hz).process(held)
    _, low_um, high_um = (float(part[-1]) for part in np.split(held_um, 3))
    return max(low_um, data.output_range_um[0]), min(high_um, data.output_range_um[1])


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
