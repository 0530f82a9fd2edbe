"""The calibrate command: what it prints and writes."""

import json

import pytest

from hilctl.base.calibration import CalibrationFile
from hilctl.base.yaml import load_document

ORIGIN = ("--by", "N. N.", "--reference", "interferometer")


@pytest.fixture
def pairs(tmp_path):
    path = tmp_path / "pairs.csv"
    path.write_text("reading,true\n" + "".join(f"{i},{2 * i + 1}\n" for i in range(5)))
    return path


def test_a_sensor_is_calibrated_once(hilctl, pairs, tmp_path):
    output = tmp_path / "calibration.yaml"
    arguments = ("calibrate", "sensor", pairs, "--output", output, *ORIGIN)
    code, shown, _ = hilctl(*arguments, "--json")
    printed = json.loads(shown)
    assert code == 0
    assert printed["polynomial"] == pytest.approx([1.0, 2.0])
    assert printed["output"] == str(output)
    written = load_document(output).validate(CalibrationFile).sensor
    assert (written.by, written.reference, written.range_um) == (ORIGIN[1], ORIGIN[3], (0.0, 4.0))
    assert hilctl(*arguments)[0] == 2
    assert hilctl(*arguments, "--overwrite")[0] == 0
