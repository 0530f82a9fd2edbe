"""A first experiment from Python."""

import pytest

from hilctl import api
from hilctl.base.errors import InputError


def test_what_it_writes_is_accepted(tmp_path):
    written = api.init("simulated_piezo", tmp_path / "first.yaml", settings={"safe.ramp_s": 2.0})
    assert (written.path, written.to_be_set) == (tmp_path / "first.yaml", {})
    assert written.schema.is_file()
    checked = api.check(written.path)
    assert checked.loaded.config.safe.ramp_s == 2.0
    assert checked.loaded.device.info == written.device


def test_it_says_what_only_the_owner_of_the_rig_knows(tmp_path):
    given = {"device.host": "10.0.0.5", "device.amplifier": {"gain_a_per_v": 2.0, "offset_a": -5.0}}
    written = api.init("labjack_t7", tmp_path / "rig.yaml", settings=given)
    assert "device.sensor.um_per_v" in written.to_be_set
    assert not {"device.host", "device.amplifier.gain_a_per_v"} & set(written.to_be_set)


def test_nothing_is_replaced_nor_written_where_it_may_not_start(tmp_path):
    with pytest.raises(InputError, match="must lie within"):
        api.init("simulated_piezo", tmp_path / "a.yaml", settings=["limits.drive_v=[0, 5000]"])
    assert not list(tmp_path.iterdir())
    (tmp_path / "a.yaml").write_text("mine")
    with pytest.raises(InputError, match="exists already"):
        api.init("simulated_piezo", tmp_path / "a.yaml")
    assert (tmp_path / "a.yaml").read_text() == "mine"
