"""What a recording says of its run before the first sample."""

import hashlib
import json
import platform
import sys
import uuid
from pathlib import Path

import numba
import numpy as np

from hilctl import __version__
from hilctl.experiment.check import Checked
from hilctl.machine.diagnosis import machine_facts
from hilctl.models.files import dump_model


def run_facts(checked: Checked, started: str) -> dict[str, str]:
    """Return identity, versions, device, rates and units, as text.

    Args:
        checked: The experiment that runs.
        started: Scheduled time of sample 0, ISO 8601.
    """
    loaded = checked.loaded
    config, info = loaded.config, loaded.device.info
    model_text = dump_model(loaded.model) if loaded.model else ""
    facts = {
        "run_id": str(uuid.uuid4()),
        "name": config.name,
        "description": config.description,
        "started": started,
        "hilctl": __version__,
        "python": sys.version.split()[0],
        "numpy": np.__version__,
        "numba": numba.__version__,
        "host": platform.node(),
        "kernel": f"{platform.system()} {platform.release()} {platform.machine()}",
        "device": info.name,
        "device_description": info.description,
        "simulated": str(info.simulated).lower(),
        "buffered": str(info.buffered).lower(),
        "fifo_depth": str(info.fifo_depth),
        "command_unit": info.command_unit,
        "sample_rate_hz": repr(config.sample_rate_hz),
        "block": str(config.block),
        "waveform_unit": str(config.waveform.unit),
        "waveform_samples": str(checked.forecast.samples),
        "compensator": getattr(loaded.model, "kind", "none"),
        "initial_state_run_id": checked.memory.run_id if checked.memory else "",
        "experiment_sha256": hashlib.sha256(loaded.yaml_text.encode()).hexdigest(),
        "model_sha256": hashlib.sha256(model_text.encode()).hexdigest() if model_text else "",
        "limits": config.limits.model_dump_json(exclude_none=True),
        "safe_value": repr(config.safe.value),
        "units": json.dumps(
            {
                "t_rel": "s",
                "reference_um": "um",
                "input_um": "um",
                "displacement_um": "um",
                "wanted_a, current_a, measured_a": "A",
                "wanted_v, drive_v, measured_v": "V",
            }
        ),
    }
    facts |= machine_facts(config.realtime, Path(config.recording.folder))
    return facts | {f"device.{key}": value for key, value in info.details.items()}
