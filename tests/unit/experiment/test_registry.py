"""Devices by name."""

import sys
from importlib.metadata import EntryPoint
from types import SimpleNamespace

import pytest

from hilctl.base.device import DeviceOptions
from hilctl.base.errors import InputError
from hilctl.experiment import registry


class Amplifier:
    """Stands for a device of somebody else's package."""

    Options = DeviceOptions


@pytest.fixture
def package(monkeypatch: pytest.MonkeyPatch) -> None:
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


def test_known_devices(package: None) -> None:
    """Built-in devices and installed ones are known; a built-in name can't be taken over."""
    known = registry.known_devices()
    assert set(known) >= {*registry.BUILTIN, "my_amplifier"}
    assert known["simulated_piezo"] == registry.BUILTIN["simulated_piezo"]


def test_entry_point(package: None) -> None:
    """An installed device is found by its entry point."""
    assert registry.device_class("my_amplifier") is Amplifier


@pytest.mark.parametrize(
    ("kind", "hint"),
    [
        ("simulated_terfanol", "did you mean 'simulated_terfenol'?"),
        ("my_amplifyer", "did you mean 'my_amplifier'?"),
    ],
)
def test_unknown_device_with_a_near_name(package: None, kind: str, hint: str) -> None:
    """A misspelt device is refused with the nearest known name, built in or installed."""
    with pytest.raises(InputError) as caught:
        registry.device_class(kind)
    assert str(caught.value) == f"unknown device '{kind}' ({hint})"


def test_unknown_device_without_a_near_name(package: None) -> None:
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
def test_device_that_can_not_be_loaded(package: None, kind: str, reason: str) -> None:
    """A device whose module or class is missing is refused with the reason."""
    with pytest.raises(InputError) as caught:
        registry.device_class(kind)
    text = str(caught.value)
    assert text.startswith(f"device '{kind}' can't be loaded: ")
    assert reason in text
