"""How the loop's process asks for real time."""

from typing import Annotated, Any, Literal

from hilctl.base.strict import BeforeValidator, Field, Strict


def _none_or_number(value: Any) -> Any:
    return None if value == "none" else value


class Realtime(Strict):
    """How the loop's process asks for real time.

    Attributes:
        priority: Its SCHED_FIFO priority.
        cpu: CPU that it runs on; ``none`` takes the first isolated one, or else leaves it open.
        require: Whether a run without SCHED_FIFO and locked memory is refused.
        wait: How it waits for a tick: ``sleep``, or ``spin``, which wakes up to 0.2 ms early
            and looks at the clock all the time until then. No timer wakes it late so, but it takes
            most of a CPU, and another one has to be left for all the rest.
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
    wait: Literal["sleep", "spin"] = "sleep"
