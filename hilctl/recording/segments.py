"""The segments of a run, from the fact that lists them."""

from collections.abc import Iterable, Iterator
from typing import Annotated

from pydantic import Field, TypeAdapter, ValidationError

from hilctl.base.samples import LAST_SAMPLE
from hilctl.base.segments import SHORTEST_PERIOD, Segment
from hilctl.base.strict import StrictModel

_MOST_TEXT = 2**24
_Index = Annotated[int, Field(ge=0, lt=LAST_SAMPLE)]


class _RecordedSegment(StrictModel):
    """The fields of a :class:`~hilctl.base.segments.Segment` as a recording has them."""

    label: str
    start: _Index
    stop: _Index
    steady_start: _Index
    steady_stop: _Index
    period: Annotated[float, Field(ge=0.0, allow_inf_nan=False)] = 0.0


_SEGMENTS = TypeAdapter(list[_RecordedSegment])


def segments_of(text: str) -> tuple[Segment, ...]:
    """Return the segments of a run from a fact of it.

    Raises:
        ValueError: They are not what :meth:`~hilctl.base.segments.Segment.to_mapping` gives, do not
            follow one another, or have no such steady part or period.
    """
    if len(text) > _MOST_TEXT:
        raise ValueError(f"segments: {len(text)} characters are more than any run has")
    try:
        recorded = _SEGMENTS.validate_json(text)
    except ValidationError as error:
        first = error.errors(include_url=False, include_input=False)[0]
        where = ".".join(map(str, first["loc"])) or "the text"
        raise ValueError(f"segments: {where}: {first['msg']}") from None
    segments = tuple(Segment(**each.model_dump()) for each in recorded)
    for problem in _problems(segments):
        raise ValueError(f"segments: {problem}")
    return segments


def _problems(segments: Iterable[Segment]) -> Iterator[str]:
    end = 0
    for number, each in enumerate(segments):
        places = [end, each.start, each.steady_start, each.steady_stop, each.stop]
        if places != sorted(places):
            yield f"{number}: its samples must follow those before it and rise: {places}"
        if 0.0 < each.period < SHORTEST_PERIOD:
            yield f"{number}: a period of {each.period!r} samples can't be"
        end = each.stop
