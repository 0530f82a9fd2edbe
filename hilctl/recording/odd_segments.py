"""Segments that are not as hilctl writes them: what can be made of them, or what is wrong."""

from typing import Annotated, Any

from pydantic import Field, TypeAdapter, ValidationError

from hilctl.base.samples import LAST_SAMPLE
from hilctl.base.strict import Strict

_Index = Annotated[int, Field(ge=0, lt=LAST_SAMPLE)]


class _RecordedSegment(Strict):
    """The fields of a :class:`~hilctl.base.segments.Segment` as a recording has them."""

    label: str
    start: _Index
    stop: _Index
    steady_start: _Index
    steady_stop: _Index
    period: Annotated[float, Field(ge=0.0)] = 0.0


_SEGMENTS = TypeAdapter(list[_RecordedSegment])


def understood(given: Any) -> list[dict[str, Any]]:
    """Return the fields of each segment.

    Args:
        given: What the JSON text says.

    Raises:
        ValueError: It is no list of segments; the message says where and why.
    """
    try:
        segments = _SEGMENTS.validate_python(given)
    except ValidationError as error:
        first = error.errors(include_url=False, include_input=False)[0]
        where = ".".join(map(str, first["loc"]))
        raise ValueError(f"segments: {where}: {first['msg']}") from None
    return [each.model_dump() for each in segments]
