"""What a catalogue knows of one recording: plain values under the names of :data:`COLUMNS`."""

import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

from hilctl.base.errors import DataError
from hilctl.recording.facts import END_FIGURES, LABELS_FACT

if TYPE_CHECKING:
    from hilctl.base.segments import Segment

Entry: TypeAlias = dict[str, Any]
"""One recording by the names of :data:`COLUMNS`; None where something is not known."""

_RUN: dict[str, type] = {
    **dict.fromkeys(("run_id", "name", "description", "started"), str),
    **dict.fromkeys(("host", "hilctl", "device", "compensator", "command_unit"), str),
    "simulated": bool,
    "sample_rate_hz": float,
}
_END: dict[str, type] = {
    **dict.fromkeys(("ended", "code", "reason"), str),
    "output_safe": bool,
    **dict.fromkeys(("recorded_samples", "missing_samples", "late_ticks", "skipped_ticks"), int),
    **dict.fromkeys(END_FIGURES, float),
}
OPTIONS = ("device", "waveform")
"""Facts of a run whose names begin so, and a point, are kept together in the column ``options``."""
COLUMNS: dict[str, type] = {
    "path": str,
    "state": str,
    "problem": str,
    "size_bytes": int,
    "mtime_ns": int,
    **_RUN,
    "waveform": str,
    "frequency_hz": float,
    "duration_s": float,
    **_END,
    LABELS_FACT: str,
    "options": str,
}
"""Names and types of what is known of a recording.

``path`` is relative to the folder that was listed, ``state`` that of
:class:`hilctl.recording.ends.RecordingEnds`, or ``unreadable``, ``waveform`` what ran, for people,
``frequency_hz`` the highest of all segments that repeat; ``labels`` and ``options`` are JSON
objects. All other names are those of facts in a recording.
"""

_BOOLEANS = {"true": True, "false": False, "True": True, "False": False}
_MOST_DIGITS = 15


def unreadable(path: str, size_bytes: int, mtime_ns: int, problem: str) -> Entry:
    """Return the entry of what is no recording that can be read."""
    known = {"path": path, "size_bytes": size_bytes, "mtime_ns": mtime_ns}
    return dict.fromkeys(COLUMNS) | known | {"state": "unreadable", "problem": problem}


def entry_of(file: Path, path: str, size_bytes: int, mtime_ns: int) -> Entry:
    """Return the entry of a file, by its head and its tail.

    Args:
        file: The file.
        path: Its name in the catalogue.
        size_bytes: Its size when it was found.
        mtime_ns: Its time of modification then, in ns.
    """
    # What reads recordings takes a second to import: a catalogue that is known needs none of it.
    from hilctl.recording.checks import labels_of
    from hilctl.recording.ends import read_ends
    from hilctl.recording.segments import segments_of

    entry = unreadable(path, size_bytes, mtime_ns, "")
    try:
        ends = read_ends(file)
        labels, segments = labels_of(ends.run), segments_of(ends.run.get("segments", "[]"))
    except DataError as error:
        return entry | {"problem": str(error).removeprefix(f"{file}: ")}
    except ValueError as error:
        return entry | {"problem": f"metadata hilctl.run: {error}"}
    entry |= {"state": ends.state, "problem": ends.problem or None}
    entry |= {name: _converted(kind, ends.run.get(name)) for name, kind in _RUN.items()}
    entry |= {name: _converted(kind, ends.end.get(name)) for name, kind in _END.items()}
    entry |= _of_segments(segments, entry["sample_rate_hz"])
    samples = (entry["recorded_samples"] or 0) + (entry["missing_samples"] or 0)
    if entry["sample_rate_hz"] and samples:
        entry["duration_s"] = samples / entry["sample_rate_hz"]
    entry[LABELS_FACT] = json.dumps(labels, ensure_ascii=False)
    options = {
        key: _plain(text)
        for key, text in ends.run.items()
        if key.startswith(_PREFIXES) and text != "None"
    }
    entry["options"] = json.dumps(options, ensure_ascii=False)
    return entry


_PREFIXES = tuple(f"{name}." for name in OPTIONS)


def _of_segments(segments: "Sequence[Segment]", sample_rate_hz: float | None) -> Mapping[str, Any]:
    periods = [segment.period for segment in segments if segment.period > 0.0]
    fastest_hz = sample_rate_hz / min(periods) if sample_rate_hz and periods else None
    text = segments[0].label if segments else None
    if len(segments) > 1:
        text = f"{text} and {len(segments) - 1} more"
    return {"waveform": text, "frequency_hz": fastest_hz}


def _converted(kind: type, text: str | None) -> Any:
    """Return a fact as a value; None where it is missing or none of that kind."""
    if text is None or kind is str:
        return text
    if kind is bool:
        return _BOOLEANS.get(text)
    if kind is int:
        return int(text) if text.isdecimal() and len(text) <= _MOST_DIGITS else None
    try:
        number = float(text)
    except ValueError:
        return None
    return number if math.isfinite(number) else None


def _plain(text: str) -> str | float | bool:
    """Return a text as the number or truth value that it stands for, if it does for one."""
    if text in _BOOLEANS:
        return _BOOLEANS[text]
    try:
        value = json.loads(text)  # not float(): a serial number keeps the zeros before it
    except (ValueError, RecursionError):
        return text
    number = isinstance(value, int | float) and abs(value) < math.inf
    return value if number else text
