"""Base of every pydantic model of the house, and the names of pydantic that models use."""

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
    """A frozen model that takes no unknown key, no other type, no NaN, no infinity."""

    model_config = ConfigDict(frozen=True, strict=True, extra="forbid", allow_inf_nan=False)
