"""One kind of model fitted to records, with creep taken off them first where it can be told."""

from dataclasses import replace

from hilctl.base.device import CommandUnit
from hilctl.identify.catalogue import CATALOGUE
from hilctl.identify.creep import creep_of, without_creep
from hilctl.identify.data.records import Records
from hilctl.identify.fit_data import FitData, search_data
from hilctl.identify.job import FitJob, FoundModel, OnProgress, ignore_progress
from hilctl.identify.settings import FitSettings
from hilctl.identify.workers import Map, one_by_one


def fit_kind(
    records: Records,
    settings: FitSettings,
    unit: CommandUnit,
    *,
    run: Map = one_by_one,
    progress: OnProgress = ignore_progress,
    start: object | None = None,
) -> FoundModel:
    """Fit a kind of model.

    Args:
        records: The data.
        settings: The kind, and all other choices.
        unit: Unit of the command.
        run: Follows starts that do not depend on each other.
        progress: Called with what is being done.
        start: Where the search begins, see :class:`~hilctl.identify.job.FitJob`.

    Raises:
        DataError: The data can't be used as asked, or there are none.
    """
    creep = creep_of(records) if settings.has("creep_stage") and settings.creep_stage else None
    bare = records if creep is None else without_creep(records, creep)
    job = FitJob(search_data(bare, settings.kind, unit), settings, run, progress, start)
    found = CATALOGUE[settings.kind].fit(job)
    if creep is None:
        return found
    crept = {"creep": creep, "output_range_um": FitData(records, unit).output_range_um}
    return replace(
        found,
        model=found.model.model_copy(update=crept),
        numbers=found.numbers + len(creep.shares),
        parameters={**found.parameters, "creep_share": sum(creep.shares)},
    )
