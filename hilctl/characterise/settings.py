"""What a step sets over the experiment: its waveform, and nothing that needs a reference in um."""

import json
from collections.abc import Iterator, Sequence
from pathlib import Path

from hilctl.base.units import CommandUnit
from hilctl.base.yaml import Document, load_document
from hilctl.characterise.waveforms import Keys
from hilctl.loop.interlocks import InterlockSettings, Needs


def waveform_setting(keys: Keys) -> str:
    """Return the ``key=value`` text that has an experiment run a waveform."""
    return f"waveform={json.dumps(keys)}"


def unit_of(experiment: Path, settings: Sequence[str]) -> CommandUnit:
    """Return the unit of the commands that an experiment limits."""
    return "V" if _document(experiment, settings).holds(("limits", "drive_v")) else "A"


def without_reference(experiment: Path, settings: Sequence[str]) -> list[str]:
    """Return settings that take out what needs a compensator: a step has none.

    Args:
        experiment: Experiment file.
        settings: ``key=value`` texts over it.

    Raises:
        InputError: The file can't be read.
        ConfigError: It is no YAML, or a text is none of these.
    """
    document = _document(experiment, settings)
    found = ["compensator=none"]
    found += [f"{key}=null" for key in ("feedback", "adaptation") if document.holds((key,))]
    return found + [
        f"limits.{key}=null" for key in _tracking_keys() if document.holds(("limits", key))
    ]


def _document(experiment: Path, settings: Sequence[str]) -> Document:
    document = load_document(experiment)
    for setting in settings:
        document.set(setting)
    return document


def _tracking_keys() -> Iterator[str]:
    """Give the interlocks that need a reference, and those that need one of them."""
    known = {
        key: [each for each in field.metadata if isinstance(each, Needs)]
        for key, field in InterlockSettings.model_fields.items()
    }
    tracking = {key for key, needs in known.items() if any(each.reference_um for each in needs)}
    for key, needs in known.items():
        if key in tracking or any(each.key in tracking for each in needs):
            yield key
