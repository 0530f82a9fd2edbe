"""Base of all pydantic models, and the pydantic names that models use."""

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
    "AfterValidator",
    "BeforeValidator",
    "Field",
    "StrictModel",
    "StringConstraints",
    "ValidationError",
    "ValidationInfo",
    "WithJsonSchema",
    "field_validator",
    "model_validator",
]


class StrictModel(BaseModel):
    """A frozen model that rejects unknown keys, other types, NaN and infinity."""

    model_config = ConfigDict(frozen=True, strict=True, extra="forbid", allow_inf_nan=False)
