"""The device of an experiment, without the rest of it."""

import json
import sys
from importlib.metadata import EntryPoint
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from hilctl.base.device import Device, DeviceInfo, DeviceOptions
from hilctl.base.errors import ConfigError, InputError
from hilctl.base.files import TextFiles
from hilctl.base.yaml import Document
from hilctl.experiment import devices as registry
from hilctl.experiment.devices import describe, inventory, made_device
from hilctl.experiment.file import schema_text
from hilctl_drivers.profile import LINK_KINDS


def made(text, folder):
    return made_device(Document("x.yaml", text), folder, TextFiles({}))


def test_what_is_wrong_elsewhere_in_the_file_is_not_in_the_way(tmp_path):
    text = "compensator: {model: gone.yaml}\ndevice: {kind: simulated_terfenol, seed: 3}"
    assert made(text, tmp_path).info.simulated
    assert made("name: no device", tmp_path) is None


@pytest.mark.parametrize(
    ("own", "voltage_max_v"), [("", 36.0), (", amplifier: {voltage_max_v: 20.0, %s}", 20.0)]
)
def test_a_simulated_rig_has_the_experiment_s_amplifier(tmp_path, own, voltage_max_v):
    coil = "resistance_ohm: 4.0, inductance_h: 0.003"
    text = "amplifier: {voltage_max_v: 36.0, %s}\ndevice: {kind: simulated_terfenol" + own + "}"
    details = made(text.replace("%s", coil), tmp_path).info.details
    assert json.loads(details["amplifier"])["voltage_max_v"] == voltage_max_v


@pytest.mark.parametrize(
    ("section", "words"),
    [("{}", "is required"), ("{kind: 3}", "must be text"), ("{kind: gone}", "unknown device")],
)
def test_a_device_that_is_none_is_refused(tmp_path, section, words):
    with pytest.raises(ConfigError, match=words):
        made(f"device: {section}", tmp_path)


class Old:
    """Was written before hilctl asked a device for its output, and has no base."""

    Options = DeviceOptions

    def __init__(self, options):
        self.info = DeviceInfo("old", "old", "A", -1.0, 1.0, -1.0, 1.0, 100.0)

    def open(self, sample_rate_hz, block): ...

    def exchange(self, first_sample, command, displacement_um, measured): ...

    def make_safe(self, command): ...

    def close(self): ...


class NotMadeSafe(Device):
    """Lacks what it seems to inherit."""

    Options = DeviceOptions
    info, open, exchange = None, Old.open, Old.exchange

    def __init__(self, options): ...


@pytest.fixture
def package(monkeypatch):
    for kind in (Old, NotMadeSafe):
        monkeypatch.setitem(registry.BUILTIN, kind.__name__, f"my_package:{kind.__name__}")
    monkeypatch.setitem(
        sys.modules, "my_package", SimpleNamespace(Old=Old, NotMadeSafe=NotMadeSafe)
    )


def test_a_device_without_optional_methods_has_their_defaults(package, tmp_path):
    assert made("device: {kind: Old}", tmp_path).output() is None


def test_required_methods_that_a_device_lacks_are_named(package, tmp_path):
    with pytest.raises(ConfigError, match="lacks make_safe, close"):
        made("device: {kind: NotMadeSafe}", tmp_path)


class Amplifier:
    """Stands for a device of somebody else's package."""

    Options = DeviceOptions


@pytest.fixture
def devices_package(monkeypatch):
    """An installed package with two devices, one of them by the name of a built-in."""
    monkeypatch.setitem(sys.modules, "my_package", SimpleNamespace(Amplifier=Amplifier, len=len))
    points = [
        EntryPoint("my_amplifier", "my_package:Amplifier", registry.GROUP),
        EntryPoint("simulated_piezo", "my_package:Amplifier", registry.GROUP),
        EntryPoint("no_module", "my_lost_package.inner:Amplifier", registry.GROUP),
        EntryPoint("no_class", "my_package:Amplifyer", registry.GROUP),
        EntryPoint("no_options", "my_package:len", registry.GROUP),
        EntryPoint("no_colon", "my_package", registry.GROUP),
    ]

    def entry_points(*, group):
        return [point for point in points if point.group == group]

    monkeypatch.setattr(registry, "entry_points", entry_points)


@pytest.mark.parametrize("kind", sorted(registry.BUILTIN))
def test_built_in(kind):
    found = registry.device_class(kind)
    module, _, name = registry.BUILTIN[kind].partition(":")
    assert (found.__module__, found.__qualname__) == (module, name)
    assert issubclass(found.Options, DeviceOptions)
    assert found.Options.model_json_schema()["additionalProperties"] is False


def test_known_devices(devices_package):
    known = registry.known_devices()
    assert set(known) >= {*registry.BUILTIN, "my_amplifier"}
    assert known["simulated_piezo"] == registry.BUILTIN["simulated_piezo"]


@pytest.mark.parametrize(("kind", "hint"), [
    ("simulated_terfanol", "did you mean 'simulated_terfenol'?"),
    ("my_amplifyer", "did you mean 'my_amplifier'?"),
    ("qqqq", "known: "),
])  # fmt: skip
def test_unknown_device(devices_package, kind, hint):
    """The nearest known name is suggested, or all of them are listed in order."""
    if hint == "known: ":
        hint += ", ".join(sorted(registry.known_devices()))
    with pytest.raises(InputError) as caught:
        registry.device_class(kind)
    assert str(caught.value) == f"unknown device '{kind}' ({hint})"


@pytest.mark.parametrize(("kind", "reason"), [
    ("no_module", "No module named 'my_lost_package'"),
    ("no_class", "no attribute 'Amplifyer'"),
    ("no_options", "no attribute 'Options'"),
    ("no_colon", ""),
])  # fmt: skip
def test_device_that_can_not_be_loaded(devices_package, kind, reason):
    with pytest.raises(InputError) as caught:
        registry.device_class(kind)
    text = str(caught.value)
    assert text.startswith("cannot load device")
    assert reason in text


def test_devices_profiles_and_ports_are_listed(monkeypatch):
    ports = [SimpleNamespace(device="/dev/ttyX1", description="b")]
    monkeypatch.setattr("serial.tools.list_ports.comports", lambda: ports)
    found = inventory()
    assert "modbus_dac" in found["devices"]
    assert Path(found["profiles"]["labjack_t7"]).is_file()
    assert list(found["profiles"]) == sorted(found["profiles"])
    assert found["serial_ports"] == [{"path": "/dev/ttyX1", "description": "b"}]


@pytest.mark.parametrize("place", ["no_such_package:shipped", "hilctl_drivers.profile:no_such"])
def test_drivers_that_are_not_there_are_said(monkeypatch, place):
    monkeypatch.setattr(registry, "SHIPPED_PROFILES", place)
    with pytest.raises(InputError, match="cannot list"):
        inventory()


def test_a_device_is_described_by_its_options():
    options = {option.name: option for option in describe("modbus_dac").options}
    assert options["profile"].default is None
    assert options["timeout_s"].default == ""
    assert options["host"].default == ""
    assert "longest wait" in options["timeout_s"].description


def test_a_profile_is_described_as_it_stands():
    found = describe("labjack_t7")
    assert found.profile["model"] == "T7"
    assert any("0 to 5 V only" in note for note in found.profile["notes"])
    assert found.options == ()


def test_own_profile_is_described_and_validated(tmp_path):
    own = tmp_path / "dac.yaml"
    text = Path(describe("labjack_t7").place).read_text()
    own.write_text(text)
    assert describe(str(own)).profile["model"] == "T7"
    own.write_text(text.replace("max_rate_hz:", "max_rate:"))
    with pytest.raises(ConfigError, match="max_rate"):
        describe(str(own))


def test_a_name_that_is_neither_gets_a_hint():
    with pytest.raises(InputError, match=r"'labjak_t7'.*'labjack_t7'"):
        describe("labjak_t7")


CONFIGS = Path(__file__).parents[3] / "configs"


@pytest.fixture(scope="module")
def schema():
    """The schema as an editor reads it."""
    loaded: dict[str, Any] = json.loads(schema_text())
    return loaded


def nodes(node):
    """Yield every mapping in a schema."""
    if isinstance(node, dict):
        yield node
        node = list(node.values())
    if isinstance(node, list):
        for value in node:
            yield from nodes(value)


class TestSchema:
    def test_every_reference_resolves(self, schema):
        targets = {each["$ref"] for each in nodes(schema) if "$ref" in each}
        names = {target.removeprefix("#/$defs/") for target in targets}
        assert all(target.startswith("#/$defs/") for target in targets)
        mappings = [each["mapping"] for each in nodes(schema) if "mapping" in each]
        mapped = {value.removeprefix("#/$defs/") for each in mappings for value in each.values()}
        assert mapped <= names
        assert names == set(schema["$defs"])

    def test_unknown_keys_are_refused_everywhere(self, schema):
        found = [each for each in nodes(schema) if "properties" in each]
        assert len(found) > 15
        assert all(each["additionalProperties"] is False for each in found)
        assert all(set(each.get("required", [])) <= set(each["properties"]) for each in found)

    def test_devices(self, schema):
        one = schema["$defs"]["Experiment"]
        choices = [each["$ref"] for each in one["properties"]["device"]["oneOf"]]
        assert choices == [f"#/$defs/device_{kind}" for kind in registry.known_devices()]
        for kind in registry.known_devices():
            part = schema["$defs"][f"device_{kind}"]
            assert part["properties"]["kind"] == {"const": kind}
            assert "kind" in part["required"]
            options = registry.device_class(kind).Options
            assert set(part["properties"]) == {"kind", *options.model_fields}

    def test_file_is_up_to_date(self):
        path = CONFIGS / "schema.json"
        assert path.read_text(encoding="utf-8") == schema_text(), (
            "configs/schema.json is out of date: run `hilctl schema --output configs/schema.json`"
        )


def test_every_link_has_a_name():
    assert set(registry._PROTOCOLS) == set(LINK_KINDS)


@pytest.mark.parametrize("name", ["LabJack_T7", "labjack-t7", "LABJACK T7"])
def test_a_name_is_found_in_any_case_and_with_any_separator(name):
    assert registry.describe(name).name == "labjack_t7"


@pytest.mark.parametrize(("name", "offered"), [
    ("labjack", ["labjack_t4", "labjack_t7", "labjack_t8"]),
    ("kepco_pob", ["kepco_bop"]),
    ("Advantech", ["adam_4024", "adam_6217"]),  # a vendor
    ("dspace", ["which_hardware"]),
])  # fmt: skip
def test_unknown_names_are_answered_by_the_likely_ones(name, offered):
    with pytest.raises(InputError) as caught:
        registry.describe(name)
    assert all(each in str(caught.value) for each in offered)
    assert len(str(caught.value)) < 200
