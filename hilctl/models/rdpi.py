"""The rate-dependent Prandtl-Ishlinskii model (chapter 5 of the dissertation)."""

from typing import Literal

from pydantic import Field

from hilctl.models.plays import PlayModel


class RdpiModel(PlayModel):
    """Pi[v] = a_0 v + sum a_i Gamma_i[v], thresholds r_i + gamma |v'| (5.5, 6.18).

    All thresholds grow alike, so their distances stay what they are and the dilation condition
    for the inverse (5.7) holds at every rate.

    Attributes:
        gamma_s: Growth of every threshold with the input's rate, in s, >= 0.
    """

    kind: Literal["rdpi"] = "rdpi"
    gamma_s: float = Field(default=0.0, ge=0.0)

    @property
    def threshold_growth_s(self) -> float:
        """Growth of every threshold with the input's rate, gamma, in s."""
        return self.gamma_s
