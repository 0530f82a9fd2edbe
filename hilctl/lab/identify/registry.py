"""Registry of the kinds of model that can be identified, with their fits."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

from hilctl.base.errors import InputError
from hilctl.base.formatting import did_you_mean
from hilctl.lab.identify.field.duhem_search import fit_generalised_duhem
from hilctl.lab.identify.field.field_search import fit_field
from hilctl.lab.identify.fit_api import FitJob, FoundModel
from hilctl.lab.identify.literature import (
    fit_bouc_wen,
    fit_duhem,
    fit_generalised,
    fit_kp,
    fit_preisach,
    fit_straight,
)
from hilctl.lab.identify.searched.butterfly import fit_butterfly
from hilctl.lab.identify.searched.plays import fit_exponential, fit_plays
from hilctl.lab.identify.settings import FitKind
from hilctl.lab.identify.staged.staged_fits import fit_free, fit_staged

ANY = "steady loops, or whole histories"
HISTORIES = "whole histories"
LOOPS = "steady loops"
STAGES = "steady loops at one sample rate"


@dataclass(frozen=True, slots=True)
class CatalogueEntry:
    """A kind of model: its equations, the method of its fit, and the records that it takes."""

    title: str
    found_by: str
    data: str
    fit: Callable[[FitJob], FoundModel]


def _fit_integrated(job: FitJob) -> FoundModel:
    return fit_free(job) if job.settings.weights == "free" else fit_exponential(job)


_SEARCH = "least squares from several starts"
_NNLS = "non-negative least squares with a smoothness prior"
_WEIGHTS_FOLLOW = "least squares on the shape, linear in the weights"

CATALOGUE: Mapping[FitKind, CatalogueEntry] = {
    "integrated": CatalogueEntry(
        "integrated, Omega: rate, asymmetry (6.18-6.24)", _SEARCH, ANY, _fit_integrated
    ),
    "staged": CatalogueEntry(
        "Omega between field lag, structure and delay", "all parts together", STAGES, fit_staged
    ),
    "rdpi": CatalogueEntry("rate-dependent PI: no deadbands (5.11, 5.14)", _SEARCH, ANY, fit_plays),
    "asymmetric": CatalogueEntry(
        "Omega with gamma = 0: no rate (1.14-1.16)", _SEARCH, ANY, fit_free
    ),
    "ppi": CatalogueEntry("PI: no rate, no deadbands (3.25-3.27)", _SEARCH, ANY, fit_plays),
    "spi": CatalogueEntry("PI, undone by stop operators (3.11-3.24)", _SEARCH, ANY, fit_plays),
    "generalised": CatalogueEntry(
        "generalised PI, tanh envelopes (1.17-1.20)", _WEIGHTS_FOLLOW, ANY, fit_generalised
    ),
    "preisach": CatalogueEntry("Preisach (1.1-1.2)", _NNLS, ANY, fit_preisach),
    "kp": CatalogueEntry("Krasnosel'skii-Pokrovskii (1.3-1.5)", _NNLS, ANY, fit_kp),
    "bouc_wen": CatalogueEntry("Bouc-Wen (1.21)", _WEIGHTS_FOLLOW, ANY, fit_bouc_wen),
    "duhem": CatalogueEntry("Duhem, Coleman-Hodgdon (1.22)", _WEIGHTS_FOLLOW, ANY, fit_duhem),
    "butterfly": CatalogueEntry(
        "plays, then an even function: rods without bias", _WEIGHTS_FOLLOW, LOOPS, fit_butterfly
    ),
    "field": CatalogueEntry(
        "plays of an effective field, with its losses",
        "densities by non-negative least squares, stages by search",
        HISTORIES,
        fit_field,
    ),
    "generalised_duhem": CatalogueEntry(
        "generalised Duhem: slopes by place and direction, with losses",
        "slopes and stages together, with a smoothness prior",
        HISTORIES,
        fit_generalised_duhem,
    ),
    "straight": CatalogueEntry("straight line: no hysteresis", "least squares", ANY, fit_straight),
}


def entry(name: str) -> tuple[FitKind, CatalogueEntry]:
    """Return a kind of model and its entry; raise InputError if it is unknown."""
    for kind, known in CATALOGUE.items():
        if kind == name:
            return kind, known
    raise InputError(f"unknown kind of model '{name}' ({did_you_mean(name, list(CATALOGUE))})")
