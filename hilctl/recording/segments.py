"""The stretches of a run, from the fact of it that lists them.

What hilctl writes is plain to see. For all else there is :mod:`hilctl.recording.odd_segments`,
which says what is wrong, and takes longer to import than a short recording to read.
"""

import json
import math
from collections.abc import Iterable, Iterator
from dataclasses import fields
from typing import Any

from hilctl.base.samples import LAST_SAMPLE
from hilctl.base.segments import SHORTEST_PERIOD, Segment

_MOST_TEXT = 2**24
_KINDS = {each.name: each.type for each in fields(Segment)}
_INDICES = [name for name, kind in _KINDS.items() if kind is int]


def segments_of(text: str) -> tuple[Segment, ...]:
    """Return the stretches of a run from a fact of it.

    Raises:
        ValueError: They are not what :meth:`~hilctl.base.segments.Segment.to_mapping` gives, do not
            follow one another, or have no such steady part or period.
    """
    if len(text) > _MOST_TEXT:
        raise ValueError(f"segments: {len(text)} characters are more than any run has")
    try:
        given = json.loads(text)
        if not (isinstance(given, list) and all(map(is_plain, given))):
            from hilctl.recording.odd_segments import understood

            given = understood(given)
    except RecursionError:
        raise ValueError("segments: nested too deep") from None
    segments = tuple(map(Segment.from_mapping, given))
    for problem in _problems(segments):
        raise ValueError(f"segments: {problem}")
    return segments


def is_plain(each: Any) -> bool:
    """Return whether a segment has all fields, each of its own kind and in its range."""
    return (
        isinstance(each, dict)
        and each.keys() == _KINDS.keys()
        and all(type(each[name]) is kind for name, kind in _KINDS.items())
        and all(0 <= each[name] < LAST_SAMPLE for name in _INDICES)
        and 0.0 <= each["period"] < math.inf
    )


def _problems(segments: Iterable[Segment]) -> Iterator[str]:
    end = 0
    for number, each in enumerate(segments):
        places = [end, each.start, each.steady_start, each.steady_stop, each.stop]
        if places != sorted(places):
            yield f"{number}: its samples must follow those before it and rise: {places}"
        if 0.0 < each.period < SHORTEST_PERIOD:
            yield f"{number}: a period of {each.period!r} samples can't be"
        end = each.stop
