"""Base of every pydantic model of the house."""

from pydantic import BaseModel, ConfigDict


class Strict(BaseModel):
    """A frozen model that takes no unknown key, no value of another type, no NaN, no infinity."""

    model_config = ConfigDict(frozen=True, strict=True, extra="forbid", allow_inf_nan=False)
