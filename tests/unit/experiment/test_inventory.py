"""What can be named in a device section."""

import json
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from hilctl.base.errors import InputError
from hilctl.experiment import device as registry
from hilctl.experiment import inventory as module
from hilctl.experiment.inventory import describe, inventory, schema_text


def test_devices_profiles_and_ports_are_listed(monkeypatch):
    """Shipped profiles by path; ports in order, with what the system calls them."""
    ports = [SimpleNamespace(device="/dev/ttyX1", description="b")]
    monkeypatch.setattr("serial.tools.list_ports.comports", lambda: ports)
    found = inventory().to_mapping()
    assert "modbus_dac" in found["devices"]
    assert Path(found["profiles"]["labjack_t7"]).is_file()
    assert list(found["profiles"]) == sorted(found["profiles"])
    assert found["serial_ports"] == ({"path": "/dev/ttyX1", "description": "b"},)


@pytest.mark.parametrize("place", ["no_such_package:shipped", "hilctl_drivers.profile:no_such"])
def test_drivers_that_are_not_there_are_said(monkeypatch, place):
    monkeypatch.setattr(module, "SHIPPED_PROFILES", place)
    with pytest.raises(InputError, match="the shipped profiles can't be listed"):
        inventory()


def test_a_device_is_described_by_its_options():
    options = {option.name: option for option in describe("modbus_dac").options}
    assert options["profile"].default is None
    assert options["timeout_s"].default == "0.1"
    assert options["host"].default == ""
    assert "longest wait" in options["timeout_s"].description


def test_a_profile_is_described_as_it_stands():
    found = describe("labjack_t7")
    assert found.profile["model"] == "T7"
    assert any("0 to 5 V only" in note for note in found.profile["notes"])
    assert found.to_mapping()["options"] == ()


def test_a_name_that_is_neither_gets_a_hint():
    with pytest.raises(InputError, match=r"no device or profile 'labjak_t7'.*'labjack_t7'"):
        describe("labjak_t7")


CONFIGS = Path(__file__).parents[3] / "configs"


@pytest.fixture(scope="module")
def schema() -> dict[str, Any]:
    """The schema as an editor reads it."""
    loaded: dict[str, Any] = json.loads(schema_text())
    return loaded


def references(node: Any) -> Iterator[str]:
    """Yield every $ref in a schema."""
    if isinstance(node, dict):
        for key, value in node.items():
            if key == "$ref":
                yield value
            yield from references(value)
    elif isinstance(node, list):
        for value in node:
            yield from references(value)


def objects(node: Any) -> Iterator[dict[str, Any]]:
    """Yield every part of a schema that describes a mapping with known keys."""
    if isinstance(node, dict):
        if "properties" in node:
            yield node
        for value in node.values():
            yield from objects(value)
    elif isinstance(node, list):
        for value in node:
            yield from objects(value)


class TestSchema:
    """The JSON schema for editors."""

    def test_every_reference_resolves(self, schema: dict[str, Any]) -> None:
        """Each $ref leads to a definition, and each definition is led to."""
        targets = set(references(schema))
        names = {target.removeprefix("#/$defs/") for target in targets}
        assert all(target.startswith("#/$defs/") for target in targets)
        mapped = {
            value.removeprefix("#/$defs/")
            for each in find_all(schema, "mapping")
            for value in each.values()
        }
        assert mapped <= names
        assert names == set(schema["$defs"])

    def test_unknown_keys_are_refused_everywhere(self, schema: dict[str, Any]) -> None:
        """An editor marks an unknown key in any section."""
        found = list(objects(schema))
        assert len(found) > 15
        assert all(each["additionalProperties"] is False for each in found)
        assert all(set(each.get("required", [])) <= set(each["properties"]) for each in found)

    def test_devices(self, schema: dict[str, Any]) -> None:
        """Every built-in device is a choice, with its kind and its own options."""
        choices = [each["$ref"] for each in schema["properties"]["device"]["oneOf"]]
        assert choices == [f"#/$defs/device_{kind}" for kind in registry.known_devices()]
        for kind in registry.known_devices():
            part = schema["$defs"][f"device_{kind}"]
            assert part["properties"]["kind"] == {"const": kind}
            assert "kind" in part["required"]
            options = registry.device_class(kind).Options
            assert set(part["properties"]) == {"kind", *options.model_fields}

    def test_required_sections(self, schema: dict[str, Any]) -> None:
        """What has no default is required."""
        assert sorted(schema["required"]) == [
            "compensator", "device", "limits", "name", "sample_rate_hz", "waveform",
        ]  # fmt: skip

    def test_compensator(self, schema: dict[str, Any]) -> None:
        """The compensator is the word none, or a model."""
        choices = schema["properties"]["compensator"]["anyOf"]
        assert {"const": "none", "type": "string"} in choices
        assert {"$ref": "#/$defs/CompensatorConfig"} in choices
        assert len(choices) == 2

    def test_waveforms(self, schema: dict[str, Any]) -> None:
        """Every kind of waveform is a choice."""
        mapping = schema["properties"]["waveform"]["discriminator"]["mapping"]
        assert set(mapping) == {
            "sine", "triangle", "complex_harmonic", "growing", "decaying", "chirp", "step", "hold",
            "multisine", "random", "path", "file", "sequence",
        }  # fmt: skip

    def test_deterministic(self) -> None:
        """The same code gives the same text."""
        assert schema_text() == schema_text()
        assert schema_text().endswith("}\n")

    def test_file_is_up_to_date(self) -> None:
        """configs/schema.json is what the code says."""
        path = CONFIGS / "schema.json"
        assert path.read_text(encoding="utf-8") == schema_text(), (
            "configs/schema.json is out of date: run `hilctl schema --output configs/schema.json`"
        )


def find_all(node: Any, key: str) -> Iterator[dict[str, str]]:
    """Yield every mapping that stands under ``key`` anywhere in a schema."""
    if isinstance(node, dict):
        for name, value in node.items():
            if name == key and isinstance(value, dict):
                yield value
            yield from find_all(value, key)
    elif isinstance(node, list):
        for value in node:
            yield from find_all(value, key)
