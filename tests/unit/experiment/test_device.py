"""The device of an experiment, without the rest of it."""

import sys
from types import SimpleNamespace

import pytest

from hilctl.base.device import Device, DeviceInfo, DeviceOptions
from hilctl.base.errors import ConfigError
from hilctl.base.files import TextFiles
from hilctl.base.yaml import Document
from hilctl.experiment import registry
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
