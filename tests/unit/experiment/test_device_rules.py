"""Rate, blocks, channels and calibration of a device."""

from datetime import UTC, datetime
from pathlib import Path

import pytest

from hilctl.base.device import AuxChannel
from hilctl.base.yaml import Document
from hilctl.experiment.device_rules import (
    calibration_warnings,
    channel_problems,
    rate_problems,
)
from hilctl.experiment.load import load_experiment, resolve
from tests.unit.base.test_calibration import CALIBRATION
from tests.unit.experiment.test_preflight import CURRENT


def loaded(text, *settings):
    return resolve(Document("x.yaml", text), Path(), settings)


@pytest.mark.parametrize(("names", "refused"), [
    (["coil_c", "c" * 63], []),
    (["c" * 64], ["c" * 64]),
    (["température", "_x", "coil_c"], ["température", "_x"]),
    (["coil_c", "coil_c"], ["coil_c"]),
    (["end", "displacement", "run_id"], ["end", "displacement", "run_id"]),
])  # fmt: skip
def test_names_of_auxiliary_channels(names, refused):
    """MATLAB accepts 63 letters, digits and '_'; no two columns or signals have one name."""
    found = channel_problems(map(AuxChannel, names))
    assert [each.key for each in found] == [f"device.aux.{name}" for name in refused]


@pytest.mark.parametrize(("now", "warnings"), [("2027-01-31", 0), ("2027-02-02", 1)])
def test_a_calibration_of_more_than_a_year_ago_is_told(tmp_path, now, warnings):
    path = tmp_path / "calibration.yaml"
    path.write_text(CALIBRATION)
    info = loaded(CURRENT, f"device.calibration={path}").device.info
    now_s = datetime.fromisoformat(f"{now}T12:00+00:00").timestamp()
    assert len(calibration_warnings(info, now_s)) == warnings
    assert len(calibration_warnings(info, 1e12)) == 1  # as a campaign asks, after the year 9999


def test_a_poor_calibration_is_told(tmp_path):
    path = tmp_path / "calibration.yaml"
    path.write_text(CALIBRATION.replace("residual_max: 0.2", "residual_max: 2.1"))
    info = loaded(CURRENT, f"device.calibration={path}").device.info
    (warning,) = calibration_warnings(info, datetime(2026, 2, 1, tzinfo=UTC).timestamp())
    assert "2.1 %" in warning


@pytest.mark.parametrize(("block", "problems"), [(58, 1), (580, 0)])
def test_a_block_too_small_for_the_rate_is_refused(block, problems):
    """A T7 streams at most 29 kHz with blocks of 58."""
    stream = Path(__file__).parents[3] / "configs" / "modbus_labjack_t7_stream.yaml"
    found = load_experiment(stream, ["sample_rate_hz=50000", f"block={block}"])
    keys = [each.key for each in rate_problems(found.device, 50000.0, block)]
    assert keys == ["block"] * problems
