"""Base of every pydantic model of the house, and what of pydantic models are written with.

The loop's process has no use for checks: what it gets was checked by the supervisor. Where it has
imported :mod:`hilctl.base.plain` before this, models hold plain values, and pydantic, a tenth of a
second and 9 MB of memory that would be locked, is not imported.
"""

import sys
from typing import TYPE_CHECKING

__all__ = [
    "AfterValidator",
    "BeforeValidator",
    "Field",
    "Strict",
    "StringConstraints",
    "ValidationError",
    "ValidationInfo",
    "WithJsonSchema",
    "field_validator",
    "model_validator",
]

if TYPE_CHECKING or "hilctl.base.plain" not in sys.modules:
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

    class Strict(BaseModel):
        """A frozen model that takes no unknown key, no other type, no NaN, no infinity."""

        model_config = ConfigDict(frozen=True, strict=True, extra="forbid", allow_inf_nan=False)

else:
    from hilctl.base import plain
    from hilctl.base.plain import Strict, ValidationError

    AfterValidator = BeforeValidator = StringConstraints = plain.Rule
    ValidationInfo = WithJsonSchema = plain.Rule
    Field = plain.field
    field_validator = model_validator = plain.validator
