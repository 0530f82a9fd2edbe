"""Parametrisations published in the dissertation."""

import numpy as np

from hilctl.base.arrays import F64
from hilctl.models.deadband import DeadbandFunction
from hilctl.models.integrated import IntegratedModel


def even_thresholds(spacing: float, operators: int) -> F64:
    """Return r_i = spacing i, i = 1 to operators: float64[operators] (3.25, 6.18)."""
    return spacing * np.arange(1, operators + 1, dtype=np.float64)


def exponential_weights(alpha: float, beta: float, operators: int) -> F64:
    """Return alpha e^(-beta i), i = 1 to operators: float64[operators] (3.26, 6.19, 6.21)."""
    return alpha * np.exp(-beta * np.arange(1, operators + 1, dtype=np.float64))


def exponential_integrated(
    *,
    alpha: float,
    gamma_s: float,
    a_0: float,
    alpha_0: float,
    beta_0: float,
    g_0: float,
    alpha_1: float,
    beta_1: float,
    d_p: float,
    alpha_2: float,
    beta_2: float,
    d_n: float,
    plays: int = 12,
    deadbands_a_side: int = 8,
) -> IntegratedModel:
    """Build Omega from the twelve published parameters (6.18-6.23).

    ``d_n`` is the spacing of the deadbands below 0 and, like ``d_p``, > 0.

    Raises:
        pydantic.ValidationError: The parameters break a condition of the model.
    """
    return IntegratedModel(
        direct=a_0,
        weights=tuple(exponential_weights(alpha_0, beta_0, plays).tolist()),
        thresholds=tuple(even_thresholds(alpha, plays).tolist()),
        gamma_s=gamma_s,
        deadband=DeadbandFunction(
            slope=g_0,
            up_thresholds=tuple(even_thresholds(d_p, deadbands_a_side).tolist()),
            up_weights=tuple((-exponential_weights(alpha_1, beta_1, deadbands_a_side)).tolist()),
            down_thresholds=tuple((-even_thresholds(d_n, deadbands_a_side)).tolist()),
            down_weights=tuple(exponential_weights(alpha_2, beta_2, deadbands_a_side).tolist()),
        ),
    )
