"""The Krasnosel'skii-Pokrovskii model."""

from collections.abc import Iterator
from typing import Literal

import numpy as np

from hilctl.kernels.implicit_models import KRASNOSELSKII_POKROVSKII
from hilctl.models.base import Weights
from hilctl.models.literature.implicit_models import ImplicitModel, PackedParameters


class KrasnoselskiiPokrovskiiModel(ImplicitModel):
    """sum rho_ij M_ij[v] (1.3-1.5), M_ij rising above alpha_i and falling below beta_j on a ridge.

    Thresholds are the levels of an even grid, alpha_i >= beta_j, and the width of a ridge is the
    spacing of the grid, so the ridges on the diagonal cover it without gaps.

    Attributes:
        lowest: Lowest level, in the input unit.
        spacing: Spacing of the levels, and width a of a ridge (1.3), > 0.
        weights: For each level i from the lowest, rho_i0 to rho_ii, um, >= 0, the last of each > 0,
            so that the inverse exists.
    """

    kind: Literal["krasnoselskii_pokrovskii"] = "krasnoselskii_pokrovskii"
    lowest: float
    spacing: float
    weights: tuple[Weights, ...]

    def _problems(self) -> Iterator[str]:
        if not self.spacing > 0.0:
            yield f"spacing must be > 0: {self.spacing!r}"
        if not self.weights:
            yield "weights must have at least one row: []"
        for i, row in enumerate(self.weights):
            if len(row) != i + 1:
                yield f"row {i} of weights must have {i + 1} values: {len(row)}"
            elif any(weight < 0.0 for weight in row) or not row[-1] > 0.0:
                yield (
                    f"weights must be >= 0, and the last of a row > 0, for the inverse to exist: "
                    f"{list(row)} in row {i}"
                )

    @property
    def operators(self) -> int:
        """Number of operators."""
        return len(self.weights) * (len(self.weights) + 1) // 2

    def packed(self) -> PackedParameters:
        """Return the parameters in the form of the kernels."""
        row, column = np.tril_indices(len(self.weights))
        levels = self.lowest + self.spacing * np.arange(len(self.weights), dtype=np.float64)
        weights = np.array([weight for row in self.weights for weight in row])
        third = np.append(weights, self.spacing).astype(np.float64)
        return KRASNOSELSKII_POKROVSKII, (levels[row], levels[column], third)
