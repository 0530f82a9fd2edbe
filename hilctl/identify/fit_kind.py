"""One kind of model fitted to records, with what stands behind it taken off them first."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from hilctl.base.types import CommandUnit
from hilctl.identify.creep_fit import creep_of, without_creep
from hilctl.identify.data.records import Records
from hilctl.identify.fit_api import FitJob, FoundModel, OnProgress, ignore_progress
from hilctl.identify.fit_data import FitData, search_data
from hilctl.identify.parallel import MapFunction, serial_map
from hilctl.identify.registry import CATALOGUE
from hilctl.identify.resonances import without_modes
from hilctl.identify.settings import FitSettings
from hilctl.models.linear_stages import FurtherMode


def fit_kind(
    records: Records,
    settings: FitSettings,
    unit: CommandUnit,
    *,
    run: MapFunction = serial_map,
    progress: OnProgress = ignore_progress,
    start: object | None = None,
    modes: Sequence[FurtherMode] = (),
) -> FoundModel:
    """Fit a kind of model.

    Creep that rests show is taken off the records first, and so are modes that are known; the model
    has both.

    Args:
        records: The data.
        settings: The kind, and all other choices.
        unit: Unit of the command.
        run: Follows starts that do not depend on each other.
        progress: Called with what is being done.
        start: Where the search begins, see :class:`~hilctl.identify.fit_api.FitJob`.
        modes: Further modes of the structure.

    Raises:
        DataError: The data can't be used as asked, or there are none.
    """
    creep = creep_of(records) if settings.looks_for("creep_stage") else None
    bare = records if creep is None else without_creep(records, creep)
    bare = without_modes(bare, modes) if modes else bare
    job = FitJob(search_data(bare, settings.kind, unit), settings, run, progress, start)
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
