"""The Prandtl-Ishlinskii model of play operators (chapter 3 of the dissertation)."""

from typing import Literal

from hilctl.models.plays import PlayModel


class PpiModel(PlayModel):
    """Phi[v] = p_0 v + sum p_i F_i[v], rate-independent and symmetric (3.6)."""

    kind: Literal["ppi"] = "ppi"
