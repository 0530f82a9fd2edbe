"""The models that are compared, by name, and how each is found."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from hilctl.base.errors import InputError
from hilctl.base.yaml.messages import did_you_mean
from hilctl.comparison.asymmetric import fit_asymmetric
from hilctl.comparison.data import Fitted, Frame
from hilctl.comparison.differential import fit_bouc_wen, fit_duhem
from hilctl.comparison.envelopes import fit_generalised
from hilctl.comparison.operators import fit_kp, fit_preisach, fit_straight
from hilctl.identify.identify import identify
from hilctl.identify.settings import Kind, Settings

OMEGA = "omega"
"""The model that the others are held against."""

_SEED = 1


@dataclass(frozen=True, slots=True)
class Entry:
    """A model that can be compared.

    Attributes:
        title: What it is, for people.
        fit: Finds it from loops.
    """

    title: str
    fit: Callable[[Frame], Fitted]


def _identified(kind: Kind, choices: Mapping[str, Any]) -> Callable[[Frame], Fitted]:
    """Return a fit by :func:`hilctl.identify.identify.identify`."""

    def fit(frame: Frame) -> Fitted:
        settings = replace(Settings.published(kind), input_unit=frame.unit, **choices)
        found = identify(kind, frame.loops, settings, np.random.default_rng(_SEED), lambda: 0.0)
        free = [name for name in found.parameters if name != "g_0"]  # which is 1 by definition
        return Fitted(found.model, len(free))

    return fit


# The others get every weight by itself and a constant displacement, which Omega as published has
# not: what they lack is not for want of freedom.
_FREE: Mapping[str, Any] = {
    "plays": 12,
    "weights": "free",
    "weight_by": "equal",
    "output_offset": True,
}

CATALOGUE: Mapping[str, Entry] = {
    OMEGA: Entry("integrated, Omega: rate, asymmetry", _identified("integrated", {"starts": 3})),
    "staged": Entry("Omega between field lag, structure and delay", _identified("staged", {})),
    "rdpi": Entry("rate-dependent PI: no deadbands", _identified("rdpi", _FREE)),
    "asymmetric_pi": Entry("Omega with gamma = 0: no rate", fit_asymmetric),
    "ppi": Entry("PI: no rate, no deadbands", _identified("ppi", _FREE)),
    "generalised_pi": Entry("generalised PI, tanh envelopes", fit_generalised),
    "preisach": Entry("Preisach", fit_preisach),
    "kp": Entry("Krasnosel'skii-Pokrovskii", fit_kp),
    "bouc_wen": Entry("Bouc-Wen", fit_bouc_wen),
    "duhem": Entry("Duhem (Coleman-Hodgdon)", fit_duhem),
    "straight": Entry("straight line: no hysteresis model", fit_straight),
}


def entry(name: str) -> Entry:
    """Return a model of the catalogue.

    Raises:
        InputError: There is none of that name.
    """
    if name not in CATALOGUE:
        hint = did_you_mean(name, list(CATALOGUE))
        raise InputError(f"unknown model '{name}' to compare ({hint}), or a model file (.yaml)")
    return CATALOGUE[name]
