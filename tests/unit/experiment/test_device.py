"""The device of an experiment, without the rest of it."""

import pytest

from hilctl.base.errors import ConfigError
from hilctl.base.files import TextFiles
from hilctl.base.yaml.document import Document
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
