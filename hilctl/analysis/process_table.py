"""What a run took of its machine, as its recording says."""

import json
from dataclasses import astuple, fields
from typing import Any, Literal

from hilctl.base.errors import DataError
from hilctl.base.formatting import quantity
from hilctl.machine.procfs import ProcessUsage
from hilctl.recording.metadata_keys import USAGE_FACT
from hilctl.recording.recording import Recording

_PROCESSES = {"loop", "supervisor"}
_NAMES = {each.name for each in fields(ProcessUsage)}
_MOST = 2**63


def processes_of(recording: Recording) -> dict[str, ProcessUsage]:
    """Return what ``loop`` and ``supervisor`` took while a run went on; empty where it is not said.

    Raises:
        DataError: What it says is not that.
    """
    text = recording.end.get(USAGE_FACT, "{}")
    where = f"{recording.path}: hilctl.end: {USAGE_FACT}"
    found = _plain(text)
    if found is None:
        found = _understood(text, where)
    if any(not 0 <= value < _MOST for each in found.values() for value in astuple(each)):
        raise DataError(f"{where}: every number must be in [0, 2^63)")
    return found


def _plain(text: str) -> dict[str, ProcessUsage] | None:
    """Return what hilctl has written; None where it is anything else."""
    try:
        given = json.loads(text)
    except (ValueError, RecursionError):
        return None
    if not (isinstance(given, dict) and given.keys() <= _PROCESSES):
        return None
    if not all(map(_is_plain, given.values())):
        return None
    return {name: ProcessUsage(**each) for name, each in given.items()}


def _is_plain(each: Any) -> bool:
    whole = isinstance(each, dict) and each.keys() == _NAMES
    return whole and all(type(value) is int for value in each.values())


def _understood(text: str, where: str) -> dict[str, ProcessUsage]:
    from pydantic import TypeAdapter, ValidationError  # only to say what is wrong, as a rule

    try:
        found = TypeAdapter(dict[Literal["loop", "supervisor"], ProcessUsage]).validate_json(text)
    except ValidationError as error:
        first = error.errors(include_url=False, include_input=False)[0]
        place = ".".join(str(part) for part in first["loc"])
        raise DataError(f"{where}: {place}: {first['msg']}") from None
    return {str(name): usage for name, usage in found.items()}


def usage_text(usage: ProcessUsage) -> str:
    """Return it for people."""
    megabytes = f"{usage.resident_bytes / 1e6:.0f} MB"
    faults = f"{usage.minor_faults + usage.major_faults:,} page faults"
    return (
        f"{megabytes}, {quantity(usage.cpu_ns * 1e-9, 's')} of CPU, {faults}, "
        f"{usage.major_faults:,} from a disk; {usage.involuntary_switches:,} involuntary switches"
    )
