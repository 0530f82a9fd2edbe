"""Simulated runs of several axes."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from hilctl import api


def run_of_axes(
    experiment: Path, folder: Path, axes: Mapping[str, Mapping[str, Any]], name: str = "one"
) -> dict[str, Path]:
    """Run a one-axis experiment with axes of their own settings; return NAME.AXIS.mcap of each."""
    settings = {
        f"axes.{axis}.{key}": value for axis, keys in axes.items() for key, value in keys.items()
    }
    texts = [f"{key}={json.dumps(value)}" for key, value in settings.items()]
    result = api.run(experiment, folder / f"{name}.mcap", settings=texts, fast=True)
    return {axis: each.path for axis, each in result.axes.items()}
