"""The JSON schema of experiment files, for editors."""

import json
from typing import Any

from hilctl.base.device import DeviceOptions
from hilctl.experiment.device import device_class, known_devices
from hilctl.experiment.file import Experiment


def experiment_schema() -> dict[str, Any]:
    """Return the JSON schema of experiment files, with the options of all known devices."""
    schema = Experiment.model_json_schema()
    definitions = schema["$defs"]
    choices = []
    for kind in known_devices():
        options: type[DeviceOptions] = device_class(kind).Options
        part = options.model_json_schema()
        definitions.update(part.pop("$defs", {}))
        part["properties"] = {"kind": {"const": kind}, **part.get("properties", {})}
        part["required"] = ["kind", *part.get("required", [])]
        definitions[f"device_{kind}"] = part
        choices.append({"$ref": f"#/$defs/device_{kind}"})
    schema["properties"]["device"] = {"oneOf": choices, "description": "kind and its options"}
    return {"$schema": "https://json-schema.org/draft/2020-12/schema", **schema}


def schema_text() -> str:
    """Return the JSON schema as the text of ``configs/schema.json``."""
    return json.dumps(experiment_schema(), indent=1, sort_keys=True) + "\n"
