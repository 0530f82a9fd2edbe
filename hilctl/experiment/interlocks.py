"""Interlocks from an experiment: what they are set to, and what is known of them before a run."""

from hilctl.base.device import DeviceInfo
from hilctl.base.errors import ConfigProblem
from hilctl.experiment.file import Experiment
from hilctl.experiment.load import LoadedExperiment
from hilctl.loop.interlocks import InterlockContext, InterlockRequirement, InterlockSettings

_TRAVEL = 0.02  # of the command's range: far beyond noise, and far less than any run worth watching


def interlock_context(config: Experiment, info: DeviceInfo) -> InterlockContext:
    """Return what the interlocks of a run need to know of the rig.

    Args:
        config: The experiment.
        info: What its device says of itself.
    """
    low, high = config.limits.command_range
    return InterlockContext(
        stroke_um=config.limits.stroke_um,
        sensor_um=(info.sensor_min_um, info.sensor_max_um),
        unit=config.limits.unit,
        safe=config.safe.value,
        frozen_travel=_TRAVEL * (high - low),
    )


def interlock_problems(loaded: LoadedExperiment) -> list[ConfigProblem]:
    """Return interlocks that could not do what they say, each by its key."""
    limits = loaded.config.limits
    found = []
    for key, field in InterlockSettings.model_fields.items():
        for needs in field.metadata:
            if isinstance(needs, InterlockRequirement) and getattr(limits, key) is not None:
                found += [(key, rule) for rule in _unmet(needs, loaded)]
    return [
        ConfigProblem(loaded.document.where(("limits", key)), f"limits.{key}", rule)
        for key, rule in found
    ]


def _unmet(needs: InterlockRequirement, loaded: LoadedExperiment) -> list[str]:
    """Return what a key needs and does not have, in words."""
    limits, info = loaded.config.limits, loaded.device.info
    rules = []
    if needs.unit is not None and needs.unit != limits.unit:
        driven = f"is for a device driven in {needs.unit}"
        rules.append(f"{driven}, but the limits are in {limits.unit}")
    if needs.key is not None and getattr(limits, needs.key) is None:
        unit = f"_{limits.unit.lower()}" if needs.key == "measured_deviation" else ""
        rules.append(f"needs limits.{needs.key}{unit}")
    if needs.reference_um and loaded.config.compensator is None:
        rules.append("needs a compensator: without one there is no reference in um to track")
    if needs.measured and not info.measures_command:
        rules.append(f"needs a device that measures its command: {info.name} does not")
    return rules
