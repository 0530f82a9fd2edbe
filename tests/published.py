"""Parameter sets published in the dissertation; the shipped models hold the same numbers."""

import numpy as np

from hilctl.models.base import Provenance
from hilctl.models.integrated import even_thresholds, exponential_weights
from hilctl.models.plays import PpiModel, RdpiModel

_DISSERTATION = (
    "Modeling and Compensation of Rate-Dependent Asymmetric Hysteresis Nonlinearities of "
    "Magnetostrictive Actuators, Concordia"
)


def piezo_ppi() -> PpiModel:
    """Return the PPI of the P-753.31C piezo stage, n = 10 (section 3.4.2), V to um."""
    return PpiModel(
        input_unit="V",
        direct=0.2567,
        weights=tuple(exponential_weights(0.0383, 0.1206, 10).tolist()),
        thresholds=tuple(even_thresholds(3.548, 10).tolist()),
        provenance=Provenance(source=(_DISSERTATION,), method="section 3.4.2"),
    )


def terfenol_rdpi() -> RdpiModel:
    """Return the n = 4 RDPI of the magnetostrictive actuator at 2.3 A (section 5.3), A to um.

    The published weights give A; the published gain, 0.1803 A/um, makes them um/A.
    """
    gain_a_per_um = 0.1803
    weights = np.array([0.4261, 0.0134, 0.0638, 0.1996]) / gain_a_per_um
    return RdpiModel(
        direct=0.4870 / gain_a_per_um,
        weights=tuple(weights.tolist()),
        thresholds=tuple(even_thresholds(0.309, 4).tolist()),
        gamma_s=2.73e-4,
        provenance=Provenance(source=(_DISSERTATION,), method="section 5.3"),
    )
