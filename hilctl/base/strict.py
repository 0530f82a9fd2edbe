"""Base of all pydantic models, and the pydantic names that models use."""

from collections.abc import Iterable
from typing import Self

from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    StringConstraints,
    ValidationError,
    ValidationInfo,
    WithJsonSchema,
    field_validator,
    model_validator,
)

__all__ = [
    "AfterValidator", "BeforeValidator", "CheckedModel", "Field", "StrictModel",
    "StringConstraints", "ValidationError", "ValidationInfo", "WithJsonSchema", "field_validator",
    "first_problem", "model_validator",
]  # fmt: skip


def first_problem(error: ValidationError, whole: str = "message") -> str:
    """Return the place and text of the first problem; ``whole`` names the place of all data."""
    first = error.errors(include_url=False, include_input=False)[0]
    return f"{'.'.join(map(str, first['loc'])) or whole}: {first['msg']}"


class StrictModel(BaseModel):
    """A frozen model that rejects unknown keys, other types, NaN and infinity."""

    model_config = ConfigDict(frozen=True, strict=True, extra="forbid", allow_inf_nan=False)


class CheckedModel(StrictModel):
    """A model with conditions on several keys; one error lists every broken one."""

    def _problems(self) -> Iterable[str]:
        """Return the broken conditions."""
        return ()

    @model_validator(mode="after")
    def _check(self) -> Self:
        if text := "; ".join(self._problems()):
            raise ValueError(text)
        return self
