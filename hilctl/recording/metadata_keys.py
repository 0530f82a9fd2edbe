"""Names and checksums of the metadata of a recording."""

import json
import zlib
from collections.abc import Mapping
from typing import TypeAlias

from hilctl.base.formatting import encodable

HOLDS_FACT = "holds"
"""Fact of a run: JSON list of the resources that its device locks."""
HEAT_FACT = "coil_heat_a2"
"""Fact of a run and of its end: heat of the coil, the running mean square of its current."""
LABELS_FACT = "labels"
"""Fact of a run: its labels as a JSON object."""
END_FIGURES = (
    "peak_hysteresis_percent",
    "loop_area",
    "peak_to_peak_um",
    "peak_error_percent",
    "rms_error_percent",
)
"""Facts of the end of a run: the worst value of all segments, as in a report."""
AUX_FACT = "aux"
"""Fact of a run: its auxiliary channels, a JSON list of objects with name, unit and meaning. Prefix
of facts of its end: ``aux.NAME.min`` and ``aux.NAME.max``, the range of each channel."""
AXIS_FACT = "axis"
"""Fact of a run of several axes: name of the recorded axis."""
AXES_FACT = "axes"
"""Fact of a run of several axes: JSON list of the names of all, the fast axis first. Their
recordings have one ``run_id``."""
USAGE_FACT = "processes"
"""Fact of the end of a run: resource usage of ``loop`` and ``supervisor``, as JSON objects."""
OVERRIDES_FACT = "overrides"
"""Fact of a run: JSON list of the key=value overrides of its file."""
RECORDINGS = "recordings"
"""Default folder of recordings, relative to the working directory."""

DEVICE_FILES = "device/"
"""Prefix of the names of attachments with files of the device, such as its profile."""

CHECKSUM_FACT = "crc32"
"""Fact of every metadata record: CRC-32 of its name and other facts, in hexadecimal digits."""

LabelValue: TypeAlias = str | int | float
"""Value of a label."""


def sealed(name: str, facts: Mapping[str, str]) -> dict[str, str]:
    """Return the facts of a metadata record as UTF-8 can encode them, with their checksum."""
    facts = {key: encodable(value) for key, value in facts.items()}
    return {**facts, CHECKSUM_FACT: _checksum(name, facts)}


def unsealed(name: str, metadata: Mapping[str, str]) -> tuple[dict[str, str], bool]:
    """Return the facts of a metadata record, and whether their checksum is correct.

    Records of older versions have no checksum and pass.
    """
    facts = dict(metadata)
    says = facts.pop(CHECKSUM_FACT, None)
    return facts, says in {None, _checksum(name, facts)}


def _checksum(name: str, facts: Mapping[str, str]) -> str:
    packed = json.dumps([name, sorted(facts.items())])
    return f"{zlib.crc32(packed.encode()):08x}"
