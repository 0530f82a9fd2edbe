"""What a recording says of its run: before the first sample, and at its end.

Commands that only finish what a dead run left import this too: they have no time for numba, which
takes seconds.
"""

import hashlib
import json
import platform
import sys
import uuid
from collections.abc import Iterator
from dataclasses import asdict
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from hilctl import __version__
from hilctl.base.samples import COLUMNS
from hilctl.base.yaml import dump
from hilctl.loop.pacer import Lateness
from hilctl.loop.plan import Outcome
from hilctl.machine.diagnosis import machine_facts
from hilctl.machine.usage import ProcessUsage
from hilctl.recording.facts import (
    HEAT_FACT,
    HOLDS_FACT,
    LABELS_FACT,
    OVERRIDES_FACT,
    USAGE_FACT,
)

if TYPE_CHECKING:
    from hilctl.experiment.check import Checked
    from hilctl.experiment.load import LoadedExperiment
    from hilctl.waveforms.spec import AnyWaveform


def run_facts(
    checked: "Checked", started: str, model_yaml: str, correction_yaml: str = ""
) -> dict[str, str]:
    """Return identity, versions, device and units, as text; the layout says the rates.

    Args:
        checked: The experiment that runs.
        started: Scheduled time of sample 0, ISO 8601.
        model_yaml: The compensator's model, or empty.
        correction_yaml: What has been learned and is added to the reference, or empty.
    """
    loaded = checked.loaded
    config, info = loaded.config, loaded.device.info
    recorded = [column.field(info.command_unit) for column in COLUMNS.values()]
    facts = {
        "run_id": str(uuid.uuid4()),
        "name": config.name,
        "description": config.description,
        LABELS_FACT: json.dumps(config.labels, ensure_ascii=False),
        OVERRIDES_FACT: json.dumps(loaded.document.assignments, ensure_ascii=False),
        "started": started,
        "hilctl": __version__,
        "python": sys.version.split()[0],
        "numpy": np.__version__,
        "numba": version("numba"),
        "host": platform.node(),
        "kernel": f"{platform.system()} {platform.release()} {platform.machine()}",
        "device": info.name,
        "device_description": info.description,
        "simulated": str(info.simulated).lower(),
        "buffered": str(info.buffered).lower(),
        "fifo_depth": str(info.fifo_depth),
        "block": str(config.block),
        "waveform_samples": str(checked.forecast.samples),
        "compensator": getattr(loaded.model, "kind", "none"),
        "initial_state": checked.begun.begins,
        "initial_state_run_id": checked.begun.run_id,
        HOLDS_FACT: json.dumps(list(info.holds)),
        "experiment_sha256": experiment_sha256(loaded),
        "model_sha256": sha256_of(model_yaml),
        "correction_sha256": sha256_of(correction_yaml),
        HEAT_FACT: repr(checked.heat_a2),
        "limits": config.limits.model_dump_json(exclude_none=True),
        "safe_value": repr(config.safe.value),
        "max_missed_share": repr(config.timing.max_missed_share),
        "units": json.dumps({"t_rel": "s"} | {each.name: each.unit for each in recorded}),
    }
    facts |= {f"waveform.{key}": text for key, text in _scalars(config.waveform)}
    facts |= machine_facts(config.realtime, Path(config.recording.folder))
    return facts | {f"device.{key}": value for key, value in info.details.items()}


def _scalars(waveform: "AnyWaveform") -> Iterator[tuple[str, str]]:
    """Yield the keys of a waveform that hold one text or number, and those as text."""
    for key, value in waveform:
        if isinstance(value, str | int | float):
            yield key, str(value)


def experiment_sha256(loaded: "LoadedExperiment") -> str:
    """Return the SHA-256 of an experiment as it runs, by which a run of it is known as done.

    Without its labels: who stands beside the rig does not change what it does.
    """
    data = {key: value for key, value in loaded.document.data.items() if key != LABELS_FACT}
    return sha256_of(dump(data))


def sha256_of(text: str) -> str:
    """Return the SHA-256 of a text that a run is made of; empty where it has none."""
    return hashlib.sha256(text.encode()).hexdigest() if text else ""


def end_facts(outcome: Outcome, counters: Lateness, lost_events: int = 0) -> dict[str, str]:
    """Return the loop's own account of a run's end and the exact counters, as text.

    Args:
        outcome: How the run ended.
        counters: Its late ticks.
        lost_events: Events that found no room on their way to the recorder.
    """
    return {
        "code": outcome.code,
        "reason": outcome.reason,
        "output_safe": str(outcome.safe).lower(),
        "output_state": outcome.output,
        "late_ticks": str(counters.late_ticks),
        "skipped_ticks": str(counters.skipped_ticks),
        "worst_late_ns": str(counters.worst_ns),
        "worst_late_tick": str(counters.worst_tick),
        "longest_late_run": str(counters.longest_run),
        "dropped_in_ring": str(outcome.dropped),
        "lost_events": str(lost_events),
    }


def usage_facts(loop: ProcessUsage | None, supervisor: ProcessUsage) -> dict[str, str]:
    """Return what a run took of the machine, as text.

    Args:
        loop: In the loop's process, from its start signal on; None where it could not say it.
        supervisor: In the supervisor's.
    """
    known = {"loop": loop, "supervisor": supervisor}
    return {USAGE_FACT: json.dumps({name: asdict(each) for name, each in known.items() if each})}
