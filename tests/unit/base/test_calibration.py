"""Calibration files: their rules, and the curve of a sensor."""

import numpy as np
import pytest

from hilctl.base.calibration import CalibrationFile
from hilctl.base.errors import ConfigError, InputError
from hilctl.base.yaml import Document, dump

_ORIGIN = """
  date: 2026-01-31
  by: N. N.
  reference: interferometer
  residual_rms: 0.1
  residual_max: 0.2
"""
CALIBRATION = f"sensor:{_ORIGIN}  range_um: [-50.0, 50.0]\n  polynomial: [1.0, 1.0]\n"
"""Calibration of a sensor that reads 1 um too little."""
AMPLIFIER = f"amplifier:{_ORIGIN}  unit: A\n  range: [-1.0, 1.0]\n  gain: 1.02\n  offset: 0.01\n"
"""Calibration of an amplifier, to be added to a file."""
TABLE = CALIBRATION.replace("polynomial: [1.0, 1.0]", "table: [[-60, -58], [0, 2], [50, 50]]")


def loaded(text):
    return Document("calibration.yaml", text).validate(CalibrationFile)


@pytest.mark.parametrize("text", [CALIBRATION, TABLE, AMPLIFIER, CALIBRATION + AMPLIFIER])
def test_a_file_is_read_as_it_was_written(text):
    content = loaded(text)
    assert loaded(dump(content.model_dump(mode="json", exclude_none=True))) == content


@pytest.mark.parametrize(("text", "key"), [
    (CALIBRATION.replace("2026-01-31", "31.1.2026"), "sensor.date"),
    (CALIBRATION.replace("[1.0, 1.0]", "[1.0, -1.0]"), "sensor"),
    (CALIBRATION.replace("[1.0, 1.0]", "[1, 1, 0, 0, 0, 0]"), "sensor.polynomial"),
    (CALIBRATION.replace("[1.0, 1.0]", "[0, 1, 0, 1.0e+300]"), "sensor"),
    (CALIBRATION.replace("[1.0, 1.0]", "[0, 1, 1.0e+307, 1.0e+307]"), "sensor"),
    (CALIBRATION.replace("[1.0, 1.0]", "[0, 1.0e-3]"), "sensor"),
    (CALIBRATION.replace("[1.0, 1.0]", "[0, 2.1]"), "sensor"),
    (TABLE.replace("[50, 50]", "[50, 1.0e+308]").replace("-58", "-1.0e+308"), "sensor"),
    (CALIBRATION.replace("[-50.0, 50.0]", "[50.0, -50.0]"), "sensor"),
    (TABLE.replace("[-50.0, 50.0]", "[-50.0, 50.1]"), "sensor"),
    (TABLE.replace("[0, 2]", "[0, 60]"), "sensor"),
    (TABLE + "  polynomial: [1.0, 1.0]\n", "sensor"),
    (AMPLIFIER.replace("1.02", "0.5"), "amplifier.gain"),
    (AMPLIFIER.replace("0.01", "2.1"), "amplifier"),
    (AMPLIFIER.replace("[-1.0, 1.0]", "[0, 0]").replace("0.01", "0"), "amplifier"),
    ("{}", ""),
])  # fmt: skip
def test_a_broken_rule_is_named_with_its_key(text, key):
    with pytest.raises(ConfigError) as caught:
        loaded(text)
    (problem,) = caught.value.problems
    assert problem.key == key


@pytest.mark.parametrize(("text", "expected"), [
    (CALIBRATION, [-49.0, -49.0, 1.0, 31.0, 31.0]),
    (TABLE, [-48.0, -48.0, 2.0, 30.8, 30.8]),
])  # fmt: skip
def test_a_curve_ends_where_the_range_or_the_sensor_does(text, expected):
    """The sensor reads up to 30 um, the calibration begins at -50 um."""
    curve = loaded(text).sensor.curve(-100.0, 30.0)
    readings = np.array([-1e3, -50.0, 0.0, 30.0, 1e3])
    np.testing.assert_allclose(np.interp(readings, *curve), expected)
    with pytest.raises(InputError, match="range_um"):
        loaded(text).sensor.curve(60.0, 100.0)


@pytest.mark.parametrize(("largest", "sensor", "amplifier"), [
    (0.0, "good", "good"), (0.01, "good", "good"), (0.03, "good", "usable"),
    (0.05, "good", "poor"), (0.6, "usable", "poor"), (2.1, "poor", "poor"),
])  # fmt: skip
def test_the_largest_residual_is_graded_against_the_calibrated_range(largest, sensor, amplifier):
    """The ranges are 100 um and 2 A."""
    text = (CALIBRATION + AMPLIFIER).replace("residual_max: 0.2", f"residual_max: {largest}")
    assert [each.grade for each in loaded(text).parts.values()] == [sensor, amplifier]
