"""What a run took of its machine, as its recording says."""

from dataclasses import astuple
from typing import Literal

from pydantic import TypeAdapter, ValidationError

from hilctl.base.errors import DataError
from hilctl.base.quantity import quantity
from hilctl.machine.usage import ProcessUsage
from hilctl.recording.data import Recording
from hilctl.recording.facts import USAGE_FACT

_USAGE = TypeAdapter(dict[Literal["loop", "supervisor"], ProcessUsage])
_MOST = 2**63


def processes_of(recording: Recording) -> dict[str, ProcessUsage]:
    """Return what ``loop`` and ``supervisor`` took while a run went on; empty where it is not said.

    Raises:
        DataError: What it says is not that.
    """
    text = recording.end.get(USAGE_FACT, "{}")
    where = f"{recording.path}: hilctl.end: {USAGE_FACT}"
    try:
        found = _USAGE.validate_json(text)
    except ValidationError as error:
        first = error.errors(include_url=False, include_input=False)[0]
        place = ".".join(str(part) for part in first["loc"])
        raise DataError(f"{where}: {place}: {first['msg']}") from None
    if any(not 0 <= value < _MOST for each in found.values() for value in astuple(each)):
        raise DataError(f"{where}: every number must be in [0, 2^63)")
    return {str(name): usage for name, usage in found.items()}


def usage_text(usage: ProcessUsage) -> str:
    """Return it for people."""
    megabytes = f"{usage.resident_bytes / 1e6:.0f} MB"
    faults = f"{usage.minor_faults + usage.major_faults:,} page faults"
    return (
        f"{megabytes}, {quantity(usage.cpu_ns * 1e-9, 's')} of CPU, {faults}, "
        f"{usage.major_faults:,} from a disk; {usage.involuntary_switches:,} involuntary switches"
    )
