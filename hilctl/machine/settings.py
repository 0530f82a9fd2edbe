"""How the loop's process asks for real time."""

from typing import Annotated, Any, Literal

from hilctl.base.strict import BeforeValidator, Field, StrictModel


def _none_or_number(value: Any) -> Any:
    return None if value == "none" else value


class Realtime(StrictModel):
    """How the loop's process asks for real time.

    Attributes:
        priority: Its SCHED_FIFO priority.
        cpu: CPU that it runs on; ``none`` takes the first isolated one, or else leaves it open.
        require: Whether a run without SCHED_FIFO and locked memory is refused.
    """

    priority: Annotated[int, Field(ge=1, le=98)] = 80
    cpu: Annotated[
        Annotated[int, Field(ge=0)] | None,
        BeforeValidator(
            _none_or_number,
            json_schema_input_type=Literal["none"] | Annotated[int, Field(ge=0)],
        ),
    ] = None
    require: bool = False
