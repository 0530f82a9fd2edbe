"""Names of facts in a recording that more than one module goes by; importing it costs nothing."""

import json
import zlib
from collections.abc import Mapping
from typing import TypeAlias

HOLDS_FACT = "holds"
"""Fact of a run: JSON list of what its device holds alone while it is open."""
HEAT_FACT = "coil_heat_a2"
"""Fact of a run and of its end: heat of the coil then, the running mean square of its current."""
LABELS_FACT = "labels"
"""Fact of a run: its labels as a JSON object."""
END_FIGURES = (
    "peak_hysteresis_percent",
    "loop_area",
    "peak_to_peak_um",
    "peak_error_percent",
    "rms_error_percent",
)
"""Facts of the end of a run: the worst figure of its segments, where any has it; as in a report."""
USAGE_FACT = "processes"
"""Fact of the end of a run: what ``loop`` and ``supervisor`` took of the machine while it went on,
a JSON object of each."""
OVERRIDES_FACT = "overrides"
"""Fact of a run: JSON list of the key=value texts that were set over its file."""
RECORDINGS = "recordings"
"""Folder of recordings, relative to where hilctl runs, where no other is given."""

CHECKSUM_FACT = "crc32"
"""Fact of every metadata record: CRC-32 of its name and its other facts, as hexadecimal digits."""

LabelValue: TypeAlias = str | int | float
"""A label says text or a number."""


def sealed(name: str, facts: Mapping[str, str]) -> dict[str, str]:
    """Return the facts of a metadata record with their checksum."""
    return {**facts, CHECKSUM_FACT: _checksum(name, facts)}


def unsealed(name: str, metadata: Mapping[str, str]) -> tuple[dict[str, str], bool]:
    """Return the facts of a metadata record, and whether their checksum is right.

    A record of an older hilctl has none, and passes.
    """
    facts = dict(metadata)
    says = facts.pop(CHECKSUM_FACT, None)
    return facts, says in {None, _checksum(name, facts)}


def _checksum(name: str, facts: Mapping[str, str]) -> str:
    packed = json.dumps([name, sorted(facts.items())])
    return f"{zlib.crc32(packed.encode()):08x}"
