"""The device of an experiment, without the rest of it."""

import sys
from importlib.metadata import EntryPoint
from types import SimpleNamespace

import pytest

from hilctl.base.device import Device, DeviceInfo, DeviceOptions
from hilctl.base.errors import ConfigError, InputError
from hilctl.base.files import TextFiles
from hilctl.base.yaml import Document
from hilctl.experiment import device as registry
from hilctl.experiment.device import made_device


def made(text, folder):
    return made_device(Document("x.yaml", text), folder, TextFiles({}))


def test_what_is_wrong_elsewhere_in_the_file_is_not_in_the_way(tmp_path):
    """A coil must not wait for a model that is gone."""
    text = "compensator: {model: gone.yaml}\ndevice: {kind: simulated_terfenol, seed: 3}"
    assert made(text, tmp_path).info.simulated
    assert made("name: no device", tmp_path) is None


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
    with pytest.raises(ConfigError, match="NotMadeSafe lacks make_safe, close"):
        made("device: {kind: NotMadeSafe}", tmp_path)


class Amplifier:
    """Stands for a device of somebody else's package."""

    Options = DeviceOptions


@pytest.fixture
def devices_package(monkeypatch: pytest.MonkeyPatch) -> None:
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

    def entry_points(*, group: str) -> list[EntryPoint]:
        return [point for point in points if point.group == group]

    monkeypatch.setattr(registry, "entry_points", entry_points)


@pytest.mark.parametrize("kind", sorted(registry.BUILTIN))
def test_built_in(kind: str) -> None:
    """Every built-in device can be imported, and its options are described for the schema."""
    found = registry.device_class(kind)
    module, _, name = registry.BUILTIN[kind].partition(":")
    assert (found.__module__, found.__qualname__) == (module, name)
    assert issubclass(found.Options, DeviceOptions)
    assert found.Options.model_json_schema()["additionalProperties"] is False


def test_known_devices(devices_package: None) -> None:
    """Built-in devices and installed ones are known; a built-in name can't be taken over."""
    known = registry.known_devices()
    assert set(known) >= {*registry.BUILTIN, "my_amplifier"}
    assert known["simulated_piezo"] == registry.BUILTIN["simulated_piezo"]


def test_entry_point(devices_package: None) -> None:
    """An installed device is found by its entry point."""
    assert registry.device_class("my_amplifier") is Amplifier


@pytest.mark.parametrize(
    ("kind", "hint"),
    [
        ("simulated_terfanol", "did you mean 'simulated_terfenol'?"),
        ("my_amplifyer", "did you mean 'my_amplifier'?"),
    ],
)
def test_unknown_device_with_a_near_name(devices_package: None, kind: str, hint: str) -> None:
    """A misspelt device is refused with the nearest known name, built in or installed."""
    with pytest.raises(InputError) as caught:
        registry.device_class(kind)
    assert str(caught.value) == f"unknown device '{kind}' ({hint})"


def test_unknown_device_without_a_near_name(devices_package: None) -> None:
    """Where no name is near, all known ones are listed in order."""
    with pytest.raises(InputError) as caught:
        registry.device_class("qqqq")
    known = ", ".join(sorted(registry.known_devices()))
    assert str(caught.value) == f"unknown device 'qqqq' (known: {known})"


@pytest.mark.parametrize(
    ("kind", "reason"),
    [
        ("no_module", "No module named 'my_lost_package'"),
        ("no_class", "no attribute 'Amplifyer'"),
        ("no_options", "no attribute 'Options'"),
        ("no_colon", ""),
    ],
)
def test_device_that_can_not_be_loaded(devices_package: None, kind: str, reason: str) -> None:
    """A device whose module or class is missing is refused with the reason."""
    with pytest.raises(InputError) as caught:
        registry.device_class(kind)
    text = str(caught.value)
    assert text.startswith(f"device '{kind}' can't be loaded: ")
    assert reason in text
