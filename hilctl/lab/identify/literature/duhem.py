"""Fit of Duhem models in the form of Coleman and Hodgdon."""

from hilctl.lab.identify.fit_api import FitJob, FoundModel
from hilctl.lab.identify.literature.bouc_wen import DifferentialLoop
from hilctl.lab.identify.literature.weights import WEIGHTS_FOLLOW
from hilctl.lab.identify.registry import ANY, Fit
from hilctl.models.literature.duhem import DuhemModel


def fit_duhem(job: FitJob) -> FoundModel:
    """Fit a, b and c of the Coleman-Hodgdon form (1.22)."""
    shape = DifferentialLoop(job, 1, free=False)
    point = shape.search()
    a, _ = shape.parameters(point)
    (b, difference), offset_um, _ = shape.solve(point)
    model = DuhemModel(
        command_span=job.data.command_span,
        a=a,
        b=float(b),
        c=float(b - difference),
        **job.data.common(offset_um),
    )
    known = {"a": model.a, "b": model.b, "c": model.c, "output_offset_um": offset_um}
    return FoundModel(model, len(known), known)


DUHEM = Fit("Duhem, Coleman-Hodgdon (1.22)", WEIGHTS_FOLLOW, ANY, fit_duhem, compared={})
