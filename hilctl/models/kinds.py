"""Kinds of model by name: the classes of model files, and the fits of ``hilctl identify --model``.

A kind is registered as text, so a run imports only the module of its own model, and no fit. A fit
may return a model of another kind. A package adds a kind with::

    [project.entry-points."hilctl.models"]
    my_kind = "my_package.model:MyModel"

    [project.entry-points."hilctl.fits"]
    my_kind = "my_package.fit:MY_FIT"
"""

from collections.abc import Mapping
from pkgutil import resolve_name
from typing import Any

from hilctl.base.errors import InputError
from hilctl.base.formatting import did_you_mean
from hilctl.base.plugins import registered

MODELS = "hilctl.models"
"""Group of subclasses of :class:`hilctl.models.base.HysteresisModel`, by their ``kind``."""
FITS = "hilctl.fits"
"""Group of :class:`hilctl.lab.identify.registry.Fit`, which the laboratory loads."""
_LITERATURE = "hilctl.models.literature"
BUILTIN: Mapping[str, Mapping[str, str]] = {
    MODELS: {
        "ppi": "hilctl.models.plays:PpiModel",
        "spi": "hilctl.models.plays:SpiModel",
        "rdpi": "hilctl.models.plays:RdpiModel",
        "integrated": "hilctl.models.integrated:IntegratedModel",
        "staged": "hilctl.models.staged:StagedModel",
        "butterfly": f"{_LITERATURE}.butterfly:ButterflyModel",
        "generalised": f"{_LITERATURE}.generalised_plays:GeneralisedModel",
        "preisach": f"{_LITERATURE}.preisach:PreisachModel",
        "krasnoselskii_pokrovskii": f"{_LITERATURE}.krasnoselskii:KrasnoselskiiPokrovskiiModel",
        "bouc_wen": f"{_LITERATURE}.bouc_wen:BoucWenModel",
        "duhem": f"{_LITERATURE}.duhem:DuhemModel",
        "field": "hilctl.models.effective_field:FieldModel",
        "generalised_duhem": "hilctl.models.generalised_duhem:GeneralisedDuhemModel",
        "refined": "hilctl.models.refined:RefinedModel",
    },
    FITS: {
        "integrated": "hilctl.lab.identify.staged.staged_fits:INTEGRATED",
        "staged": "hilctl.lab.identify.staged.staged_fits:STAGED",
        "rdpi": "hilctl.lab.identify.searched.plays:RDPI",
        "asymmetric": "hilctl.lab.identify.staged.staged_fits:ASYMMETRIC",
        "ppi": "hilctl.lab.identify.searched.plays:PPI",
        "spi": "hilctl.lab.identify.searched.plays:SPI",
        "generalised": "hilctl.lab.identify.literature.generalised_plays:GENERALISED",
        "preisach": "hilctl.lab.identify.literature.preisach:PREISACH",
        "kp": "hilctl.lab.identify.literature.krasnoselskii:KP",
        "bouc_wen": "hilctl.lab.identify.literature.bouc_wen:BOUC_WEN",
        "duhem": "hilctl.lab.identify.literature.duhem:DUHEM",
        "butterfly": "hilctl.lab.identify.literature.butterfly:BUTTERFLY",
        "field": "hilctl.lab.identify.field.field_search:FIELD",
        "generalised_duhem": "hilctl.lab.identify.field.duhem_search:GENERALISED_DUHEM",
        "straight": "hilctl.lab.identify.literature.straight:STRAIGHT",
    },
}


def known(group: str) -> dict[str, str]:
    """Return the names of a group, each with its ``module:object``; names of hilctl first."""
    others = {name: point.value for name, point in registered(group).items()}
    return {**BUILTIN[group], **others, **BUILTIN[group]}


def load(group: str, name: str) -> Any:
    """Return a registered object; raise InputError if it is unknown or cannot be loaded."""
    place = BUILTIN[group].get(name) or known(group).get(name)
    if place is None:
        raise InputError(f"unknown kind of model '{name}' ({did_you_mean(name, known(group))})")
    try:
        return resolve_name(place)
    except Exception as error:
        text = f"{type(error).__name__}: {error}"
        raise InputError(f"cannot load the kind of model '{name}' ({place}): {text}") from error
