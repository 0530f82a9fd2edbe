"""The device that an experiment names, made from its options.

The guardian of a run makes it too, without the rest of the experiment: numba must not come along.
"""

from pathlib import Path

from hilctl.base.device import Device, complete
from hilctl.base.errors import ConfigError, InputError, Problem
from hilctl.base.files import TextFiles
from hilctl.base.yaml import Document
from hilctl.experiment.registry import device_class, known_devices


def made_device(document: Document, folder: Path, files: TextFiles) -> Device | None:
    """Return the device of an experiment, made but not opened; None where it has no such section.

    Args:
        document: The experiment.
        folder: What file names in it are relative to.
        files: Where those files are read from.

    Raises:
        ConfigError: Rules are broken; the error lists every one of them.
    """
    given = document.data.get("device")
    if not isinstance(given, dict):
        return None
    kind = given.get("kind")
    where = document.where(("device", "kind"))
    if not isinstance(kind, str):
        rule, value = ("must be text", repr(kind)) if "kind" in given else ("is required", "")
        hint = f"known: {', '.join(sorted(known_devices()))}"
        raise ConfigError([Problem(where, "device.kind", rule, value, hint)])
    try:
        chosen = device_class(kind)
    except InputError as error:
        raise ConfigError([Problem(where, "device.kind", str(error))]) from None
    context = {"folder": folder, "files": files}
    options = document.validate(chosen.Options, at=("device",), without=("kind",), context=context)
    try:
        return complete(chosen(options))
    except ConfigError:
        raise
    except InputError as error:
        raise ConfigError([Problem(document.where(("device",)), "device", str(error))]) from None
