"""Runs of several axes, made of simulated runs of one axis each."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any
from unittest.mock import patch

from hilctl import api
from hilctl.recording.metadata_keys import AXES_FACT, AXIS_FACT
from hilctl.run import recorder
from hilctl.run.metadata import run_facts


def run_of_axes(
    experiment: Path, folder: Path, axes: Mapping[str, Mapping[str, Any]], run_id: str = "one"
) -> dict[str, Path]:
    """Run an experiment once per axis with its settings; return NAME.AXIS.mcap of each."""
    made = {}
    for name, settings in axes.items():
        facts = {"run_id": run_id, AXIS_FACT: name, AXES_FACT: json.dumps([*axes])}

        def of_axis(*arguments: Any, facts: Mapping[str, str] = facts) -> dict[str, str]:
            return {**run_facts(*arguments), **facts}

        path = folder / f"{run_id}.{name}.mcap"
        with patch.object(recorder, "run_facts", of_axis):
            made[name] = api.run(experiment, path, settings=settings, fast=True).path
    return made
